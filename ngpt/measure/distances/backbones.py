"""The convolutional networks whose features E-LPIPS compares, defined here so that torchvision is not needed.

Parameters have the names of torchvision, so that its files of weights can be loaded. Each network yields the features
that E-LPIPS uses, from fine to coarse: the image itself, and the output of each ReLU (of each fire module in
SqueezeNet).
"""

import hashlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, max_pool2d

from ngpt.errors import NgptError
from ngpt.system.reading import read_bytes

# The inputs of the pretrained networks: (x - shift) / scale of x in [-1, 1].
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)

# The largest file in bytes, twice as large as that of VGG16.
_LARGEST = 2**30

# A function that drops inputs of a convolution at random, the same for both images of a comparison.
Dropout = Callable[[Tensor], Tensor]


class Fire(nn.Module):
    """SqueezeNet's module: a 1x1 convolution to few channels, then 1x1 and 3x3 side by side [Iandola et al. 2016]."""

    def __init__(self, inputs: int, squeezed: int, expanded: int):
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor, dropout: Dropout) -> Tensor:
        x = dropout(torch.relu(self.squeeze(dropout(x))))
        return torch.relu(torch.cat([self.expand1x1(x), self.expand3x3(x)], 1))


class SqueezeNet(nn.Module):
    """SqueezeNet 1.1 up to its last fire module: (N, 3, H, W) in [-1, 1] to 10 features.

    Pools without padding and rounding down, as E-LPIPS does (torchvision rounds up).
    """

    CHANNELS = (3, 64, 128, 128, 256, 256, 384, 384, 512, 512)
    FILE = "squeezenet1_1-b8a52dc0.pth"
    SHA256 = "b8a52dc049b60e4b6ab68ad0df457362afab8b6304b2febdc1650a5dab4d7e7b"

    def __init__(self) -> None:
        super().__init__()
        fires = {3: (64, 16, 64), 4: (128, 16, 64), 6: (128, 32, 128), 7: (256, 32, 128)}
        fires |= {9: (256, 48, 192), 10: (384, 48, 192), 11: (384, 64, 256), 12: (512, 64, 256)}
        self.features = nn.ModuleDict({"0": nn.Conv2d(3, 64, 3, stride=2)})
        for index, sizes in fires.items():
            self.features[str(index)] = Fire(*sizes)

    def forward(self, image: Tensor, dropout: Dropout) -> Iterator[Tensor]:
        yield image
        x = torch.relu(self.features["0"](dropout(_standardised(image))))
        yield x
        for index in (3, 4, 6, 7, 9, 10, 11, 12):
            if index in (3, 6, 9):
                x = max_pool2d(x, 3, 2)
            x = self.features[str(index)](x, dropout)
            yield x


class Vgg16(nn.Module):
    """The 13 convolutions of VGG16, with average pooling: (N, 3, H, W) in [-1, 1] to 14 features."""

    CHANNELS = (3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
    FILE = "vgg16-397923af.pth"
    SHA256 = "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0"
    _CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.ModuleDict()
        for index, inputs, outputs in zip(self._CONVOLUTIONS, self.CHANNELS, self.CHANNELS[1:], strict=False):
            self.features[str(index)] = nn.Conv2d(inputs, outputs, 3, padding=1)

    def forward(self, image: Tensor, dropout: Dropout) -> Iterator[Tensor]:
        yield image
        x = _standardised(image)
        for index in self._CONVOLUTIONS:
            if index in (5, 10, 17, 24):
                x = avg_pool2d(x, 2)
            x = torch.relu(self.features[str(index)](dropout(x)))
            yield x


def _standardised(image: Tensor) -> Tensor:
    shift, scale = (torch.tensor(v, device=image.device).reshape(1, 3, 1, 1) for v in (_SHIFT, _SCALE))
    return (image - shift) / scale


def _checked(kind: type[SqueezeNet] | type[Vgg16], file: Path) -> dict[str, Tensor]:
    """The tensors in torchvision's file. It is read only once, so that the checked bytes are the loaded ones."""
    content = read_bytes(file, _LARGEST)
    if hashlib.sha256(content).hexdigest() != kind.SHA256:
        raise NgptError(
            f"{file}: its checksum is not {kind.SHA256[:8]}..., as {kind.FILE} has it; download it again, or convert "
            "other weights to .safetensors"
        )
    return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)


def load(kind: type[SqueezeNet] | type[Vgg16], path: str = "") -> nn.Module:
    """A backbone with torchvision's weights, from ``path`` or PyTorch's cache, frozen.

    A .safetensors file may hold any weights. torchvision's own file is a pickle: it is read only if it has the known
    SHA-256, and by PyTorch's reader that loads tensors and runs no code. Raises NgptError if the file does not exist,
    has another checksum, or holds other tensors.
    """
    file = Path(path or Path(torch.hub.get_dir()) / "checkpoints" / kind.FILE)
    if not file.is_file():
        raise NgptError(
            f"{file}: no such file; get {kind.FILE} from torchvision (download.pytorch.org/models) and put it "
            'there, or name it in the configuration as loss.backbone; loss.kind = "structural" needs no weights'
        )
    try:
        tensors = load_file(file) if file.suffix == ".safetensors" else _checked(kind, file)
    except NgptError:
        raise
    except Exception as error:  # a damaged archive may raise anything
        raise NgptError(f"{file}: cannot be read as PyTorch weights: {' '.join(str(error).split())[:200]}") from error
    network = kind()
    own = network.state_dict()
    for name, tensor in own.items():
        found = tensors.get(name)
        if not isinstance(found, Tensor) or found.shape != tensor.shape:
            what = list(found.shape) if isinstance(found, Tensor) else "missing"
            raise NgptError(f"{file}: tensor '{name}' should be {list(tensor.shape)}, is {what}")
        if not torch.isfinite(found).all():
            raise NgptError(f"{file}: tensor '{name}' holds values that are not finite; the file is damaged")
    network.load_state_dict({name: tensors[name] for name in own})
    return network.requires_grad_(False).eval()
