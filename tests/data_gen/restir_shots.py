"""What tests of reservoirs over frames share: images of lanes, what they converge to, and what history is worth."""

import numpy as np

SIZE, CHAINS, FRAMES = 24, 48, 3


def images(values, chains):
    """(chains, H, W, 3) of a value of each lane."""
    return np.moveaxis(np.array(values, np.float64).T.reshape(SIZE, SIZE, chains, 3), 2, 0)


def layers_of(values, chains):
    return {name: images(getattr(values, name), chains) for name in ("path", "primal", "dx", "dy")}


def rendered_by_gpt(scene):
    """The same layers of independent renders of gpt, (renders, H, W, 3)."""
    from data_gen.render import render_stack

    stacks = [render_stack(scene, 48, seed, "gpt", caustic=False).layers for seed in range(900, 908)]
    layers = {name: np.stack([stack[name] for stack in stacks]) for name in ("primal", "direct", "dx", "dy")}
    layers["primal"] = layers["path"] = layers["primal"] - layers.pop("direct")
    return layers


def noise_left(frames, name):
    """The variance of the last frame over that of the first, each beside that of its candidates."""
    variances, paths = (
        [np.sort(frame[layer].var(axis=0).mean(axis=-1).ravel())[:-10].mean() for frame in frames]
        for layer in (name, "path")
    )
    return variances[-1] / paths[-1] / (variances[0] / paths[0])
