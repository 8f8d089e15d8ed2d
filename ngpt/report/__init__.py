"""Pages to look at: the self-contained HTML report, and pages that a render keeps up to date."""
