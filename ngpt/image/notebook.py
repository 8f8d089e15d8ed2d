"""Shows a gradient stack in a notebook: a small picture and a table, as HTML without style or script."""

import base64
from collections.abc import Mapping

import numpy as np

from ngpt.image import display
from ngpt.image.png import encode_png
from ngpt.system.text import markup

WIDTH = 160  # pixels of the picture


def stack_html(title: str, layers: Mapping[str, np.ndarray]) -> str:
    """HTML with the title, a picture of the first layer (H, W, C), and each layer's least, mean and largest value.

    Only finite values count. The last column of the table is the number of pixels with a non-finite value.
    """
    name, image = next(iter(layers.items()))
    # Some of the pixels of a large image are enough, and faster.
    step = max(1, image.shape[1] // (4 * WIDTH))
    picture = encode_png(display.thumbnail(display.layer_view(name, image[::step, ::step]), WIDTH))
    source = "data:image/png;base64," + base64.b64encode(picture).decode()
    rows = "".join(_row(name, layer) for name, layer in layers.items())
    heads = "".join(f"<th>{head}</th>" for head in ("layer", "min", "mean", "max", "pixels not finite"))
    return (
        f"<p>{markup(title)}</p>"
        f'<img alt="{markup(name)}" src="{source}">'
        f"<table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table>"
    )


def value_range(layer: np.ndarray) -> dict[str, float]:
    """The least, mean and largest finite value of a layer (H, W, C), or NaN; and the number of non-finite pixels."""
    finite = np.isfinite(layer)
    values = layer[finite] if finite.any() else np.array([np.nan])
    found = {"min": float(values.min()), "mean": float(values.mean(dtype=np.float64)), "max": float(values.max())}
    return found | {"nonfinite": int(np.count_nonzero(~finite.all(axis=-1)))}


def _row(name: str, layer: np.ndarray) -> str:
    cells = [f"{number:.4g}" if isinstance(number, float) else str(number) for number in value_range(layer).values()]
    return f"<tr><th>{markup(name)}</th>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
