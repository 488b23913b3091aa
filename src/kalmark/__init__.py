"""EKF-SLAM with a covariance that stays honest."""
