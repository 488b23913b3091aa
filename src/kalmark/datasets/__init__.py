"""Readers of published data sets, of recorded images and of graphs of poses, each a format of logs."""
