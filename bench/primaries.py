"""What it costs to reconstruct in other primaries than Rec. 709, or to convert to Rec. 709.

    python -m bench.primaries demo --scenes glossy diffuse       # after make demo

within   the light is converted to other primaries and reconstructed in these: the cost of not converting
beyond   the numbers of the stack are read as other primaries and converted to Rec. 709: the cost of converting

Trimmed relMSE in the primaries of the demo's references.
"""

import argparse
from pathlib import Path

import numpy as np

from ngpt.io.exr import read, read_image
from ngpt.io.primaries import ACES_AP0, ACES_AP1, REC2020, converted, to_rec709
from ngpt.measure.metrics import relmse_trimmed
from ngpt.methods import reconstruct
from ngpt.stack import GradientStack

LIGHT, FEATURES = ("primal", "direct", "caustic", "dx", "dy"), ("albedo", "normal", "depth")
OTHERS = {"AP0": ACES_AP0, "AP1": ACES_AP1, "Rec. 2020": REC2020}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of ngpt demo")
    parser.add_argument("--scenes", nargs="+", default=["glossy", "diffuse"])
    parser.add_argument("--methods", nargs="+", default=["oidn", "ngpt-fast"])
    args = parser.parse_args()
    for scene in args.scenes:
        stack, reference = read(args.folder / f"{scene}_stack.exr"), read_image(args.folder / f"{scene}_ref.exr")
        for method in args.methods:
            print(f"{scene} {method}: {error(stack, reference, method, np.eye(3)):.3g}")
            for name, primaries in OTHERS.items():
                matrix = to_rec709({"chromaticities": primaries})
                assert matrix is not None
                within, beyond = (error(stack, reference, method, m) for m in (np.linalg.inv(matrix), matrix))
                outside = (converted(stack["primal"], matrix) < 0).any(axis=-1).mean()
                print(f"    {name}: within {within:.3g}, beyond {beyond:.3g} ({outside:.1%} of the pixels)")


def error(stack: GradientStack, reference: np.ndarray, method: str, matrix: np.ndarray) -> float:
    """The error of a reconstruction after the ``matrix`` was applied to the light.

    The stack has no variances, since no matrix converts these.
    """
    layers = {name: converted(stack[name], matrix) for name in LIGHT if name in stack}
    layers |= {name: stack[name] for name in FEATURES if name in stack}
    image = reconstruct(GradientStack(layers), method).image
    return relmse_trimmed(converted(image, np.linalg.inv(matrix)), reference)


if __name__ == "__main__":
    main()
