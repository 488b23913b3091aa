"""Records of robots, mounted sensors and landmarks beside the Gaussian."""
