"""Motion, sensor and landmark models, and the seam where they meet."""
