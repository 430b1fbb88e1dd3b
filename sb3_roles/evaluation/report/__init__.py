"""The report: one HTML page with tables, figures, an episode player and what differs from print."""

PAGE = "report.html"
"""Name of its file."""
