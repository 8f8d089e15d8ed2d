"""Pictures and pages: tone mapping, PNG, and the self-contained HTML report."""
