"""The compressed map: an exact EKF whose ordinary step does not grow with the map.  docs/compressed.md."""
