"""What a test may be skipped for where everything is set up, and why no set-up helps.

``NGPT_STRICT=1`` turns any other skip into a failure: see ``conftest.py``.
"""

import re

ALLOWED = {
    r"no GPU for PyTorch": "scripts/gpu.py makes the same check (docs/train/gpu.md)",
    r"this build of ONNX Runtime sends no telemetry": "what is to be switched off is not there",
    r"root may read anything": "a file without permissions is only closed to others",
    r"it refuses holes": "a sampler says which scenes it cannot render",
    r"E-LPIPS needs its fitted weights": "its authors' weights may not be shipped",
    r"this machine may have room for them": "images of 16 TiB",
    r"strace may not trace here": "some containers forbid it",
    r"the compiler has no ": "sanitizers that a compiler comes without",
}


def allowed(reason: str) -> bool:
    return any(re.search(pattern, reason) for pattern in ALLOWED)
