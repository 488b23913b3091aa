"""What the filter knows of robots, mounted sensors and landmarks beside the Gaussian."""
