"""Results of a run from its reports: records, figures, pictures, pages."""
