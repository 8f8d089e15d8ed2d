"""Writes pages: the HTML report in one file, and the page of a running render."""
