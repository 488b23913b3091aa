"""A live camera: its newest image goes to the filter; those that come while it works are dropped, never queued.

python examples/live_camera.py camera.yaml [0 | video.mp4]        # a calibration, and a camera's number or a video
"""

import sys
import threading
import time

import cv2
import numpy as np

import kalmark as km
from kalmark.vision.calibration_key import calibration


class Newest:
    """The newest image of a camera, which a thread of its own reads at the camera's rate."""

    def __init__(self, source: str) -> None:
        self.video = cv2.VideoCapture(int(source) if source.isdecimal() else source)
        self.pause_s = 0.0 if source.isdecimal() else 1.0 / (self.video.get(cv2.CAP_PROP_FPS) or 30.0)
        self.image, self.read, self.changed = None, 0, threading.Condition()
        threading.Thread(target=self.run, daemon=True).start()

    def run(self) -> None:
        there = True
        while there:
            there, image = self.video.read()
            with self.changed:
                self.image, self.read = (image if there else False), self.read + there
                self.changed.notify()
            time.sleep(self.pause_s)  # a file has no rate of its own

    def take(self) -> object:
        with self.changed:
            self.changed.wait_for(lambda: self.image is not None)
            image, self.image = self.image, None
        return image


def main(file: str, source: str = "0") -> None:
    lens = {key: value for key, value in calibration(file).items() if key != "mount"}
    point = km.landmarks.Homogeneous(prior_rho_per_m=0.5, sigma_rho_per_m=0.5)
    camera = km.Mount(km.sensors.PinHole(**lens), landmark=point, detector=km.vision.ActiveSearch())
    hand = km.motion.ConstantVelocity3D(sigma_v_mps_per_sqrt_s=1.0, sigma_w_radps_per_sqrt_s=2.0)
    still = np.diag(np.repeat([0.0, 0.0, 0.3, 0.5], 3) ** 2)  # m/s and rad/s, nearly: its pose is the origin
    robot = km.Robot("camera", hand, sensors={"eye": camera}, cov=still)
    slam = km.Slam([robot], estimator=km.estimators.Ekf())  # one linearisation: docs/vision.md
    slam.warm_up()
    newest, begin, done = Newest(source), None, 0  # from now on
    while (image := newest.take()) is not False:
        begin = begin or time.monotonic()
        report = slam.process(km.Frame(time.monotonic() - begin, "camera", "eye", image))
        found, done = sum(o.outcome == "associated" for o in report.observations), done + 1
        rate, (x, y, z) = done / max(time.monotonic() - begin, 1e-3), slam.mean("camera")[:3]
        dropped = f"{newest.read - done} dropped"
        print(f"\r{rate:4.0f} images/s, {dropped}, {found} found, at {x:.2f} {y:.2f} {z:.2f}", end="")
    print()


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) > 1 else print(__doc__)
