"""``python -m data_gen.samplers``: the table of ngpt's own samplers in docs/use/rendering.md."""

from data_gen.samplers import SAMPLERS, by_standing
from data_gen.samplers.registry import own
from ngpt.options import written

# Standing -> its heading in the table
GROUPS = {"use": "", "niche": "for some scenes"}


def table() -> str:
    """A table in Markdown of all samplers except studies, by standing, with their options and defaults."""
    lines, others = ["| sampler | what it is | options |", "|---|---|---|"], SAMPLERS.load()
    for standing, title in GROUPS.items():
        lines += [f"| | *{title}* | |"] if title else []
        for name, entry in by_standing(standing).items():
            if name in others:
                continue
            options = ", ".join(f"`{option}={written(value.default)}`" for option, value in own(entry.options).items())
            lines.append(f"| `{name}` | {entry.summary} | {options} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table())
