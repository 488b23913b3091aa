"""What to make of the reports of a run: records, figures, pictures, pages."""
