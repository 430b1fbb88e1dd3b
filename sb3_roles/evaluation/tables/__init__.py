"""The tables of a plan, from records to Markdown, LaTeX and CSV."""
