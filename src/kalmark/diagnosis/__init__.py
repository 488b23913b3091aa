"""Whether a run can be trusted, and if not, why: found without truth, in what the batch solution leaves of its data."""
