"""Viewers: a run in rerun, as it is recorded or again from its folder.  Registered by entry points, docs/plugins.md."""
