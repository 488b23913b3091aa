"""The life of a landmark: initialised, confirmed, merged, reparametrised, removed.  [TB] 4.4."""
