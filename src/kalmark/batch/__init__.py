"""The maximum likelihood of the same events: one sparse solver for poses, points, tags and mounts."""
