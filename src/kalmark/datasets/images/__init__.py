"""Logs of images: folders, video files, and the layouts of EuRoC, TUM RGB-D and KITTI's odometry benchmark."""
