// Drive the filter of MRPT's kf-slam (CRangeBearingKFSLAM2D, landmarks known by their ids) over steps read from stdin.
//
// All numbers are doubles.  First: landmarks n, method, range of the sensor, sigmas (along, turn, range, bearing), then
// the state x (3 + 2 n) and its covariance row by row.  Then blocks: a count of steps, each the odometry (3), a number of
// observations and for each of them (range, bearing, id).  For each block it answers with the processor's microseconds of
// each step and the pose (3).
#include <mrpt/obs/CActionRobotMovement2D.h>
#include <mrpt/obs/CObservationBearingRange.h>
#include <mrpt/slam/CRangeBearingKFSLAM2D.h>

#include <cstdio>
#include <ctime>
#include <vector>

using namespace mrpt;

struct Filter : slam::CRangeBearingKFSLAM2D
{
	void start(size_t n, const std::vector<double>& x, const std::vector<double>& P)
	{
		m_xkk.resize(x.size());
		m_pkk.setSize(x.size(), x.size());
		for (size_t i = 0; i < x.size(); i++)
		{
			m_xkk[i] = x[i];
			for (size_t j = 0; j < x.size(); j++) m_pkk(i, j) = P[i * x.size() + j];
		}
		for (size_t i = 0; i < n; i++) m_IDs.insert(i, i);
	}
};

static bool read(std::vector<double>& to)
{
	return fread(to.data(), sizeof(double), to.size(), stdin) == to.size();
}

static double number()
{
	std::vector<double> one(1, -1);
	read(one);
	return one[0];
}

static double microseconds()
{
	timespec t;
	clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
	return t.tv_sec * 1e6 + t.tv_nsec * 1e-3;
}

int main()
{
	Filter filter;
	const size_t n = number();
	filter.KF_options.method = static_cast<bayes::TKFMethod>(int(number()));
	filter.setMinLoggingLevel(system::LVL_ERROR);
	const double reach = number(), along = number(), turn = number();
	filter.options.std_sensor_range = number();
	filter.options.std_sensor_yaw = number();
	std::vector<double> x(3 + 2 * n), P(x.size() * x.size()), u(3), sight(3);
	if (!read(x) || !read(P)) return 1;
	filter.start(n, x, P);

	obs::CActionRobotMovement2D::TMotionModelOptions motion;
	motion.modelSelection = obs::CActionRobotMovement2D::mmGaussian;
	motion.gaussianModel = {0, 0, 0, 0, along, turn};
	for (double count = number(); count > 0; count = number())
	{
		std::vector<double> answer;
		std::vector<std::pair<obs::CActionCollection::Ptr, obs::CSensoryFrame::Ptr>> steps;
		for (int k = 0; k < count; k++)
		{
			read(u);
			obs::CActionRobotMovement2D moved;
			moved.computeFromOdometry(poses::CPose2D(u[0], u[1], u[2]), motion);
			auto action = obs::CActionCollection::Create();
			action->insert(moved);
			auto scan = obs::CObservationBearingRange::Create();
			scan->maxSensorDistance = reach;
			scan->fieldOfView_yaw = 2 * M_PI;
			scan->sensor_std_range = filter.options.std_sensor_range;
			scan->sensor_std_yaw = filter.options.std_sensor_yaw;
			for (int left = number(); left > 0; left--)
			{
				read(sight);
				obs::CObservationBearingRange::TMeasurement seen;
				seen.range = sight[0], seen.yaw = sight[1], seen.pitch = 0, seen.landmarkID = sight[2];
				scan->sensedData.push_back(seen);
			}
			auto frame = obs::CSensoryFrame::Create();
			frame->insert(scan);
			steps.emplace_back(action, frame);
		}
		for (auto& [action, frame] : steps)
		{
			const double begin = microseconds();
			filter.processActionObservation(action, frame);
			answer.push_back(microseconds() - begin);
		}
		for (int i = 0; i < 3; i++) answer.push_back(filter.internal_getXkk()[i]);
		fwrite(answer.data(), sizeof(double), answer.size(), stdout);
		fflush(stdout);
	}
}
