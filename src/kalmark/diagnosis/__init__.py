"""The verdict on a run, without truth: by the residuals of its batch solution."""
