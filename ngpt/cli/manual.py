"""What each verb's ``--help`` says, as a page of the documentation."""

import argparse


def markdown(verbs: dict[str, argparse.ArgumentParser]) -> str:
    """The page in Markdown; ``verbs`` are parsers by name."""
    parts = ["# Commands", "What `ngpt VERB --help` prints."]
    for name, parser in verbs.items():
        parts.append(f"## {name}\n\n```text\n{parser.format_help().rstrip()}\n```")
    return "\n\n".join(parts) + "\n"
