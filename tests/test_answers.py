"""The numbers of docs/use/answers.md and docs/use/farm.md are those of their file (`python -m bench.answers`)."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_numbers_of_the_answers_are_measured():
    measured = json.loads((ROOT / "bench" / "results" / "answers.json").read_text())
    answers, farm = ((ROOT / "docs" / "use" / f"{name}.md").read_text() for name in ("answers", "farm"))
    for scene, found in measured["features"].items():
        cells = " | ".join(f"{found[kind]:.2f}" for kind in ("ours", "d:depth", "d:depth,n:sh_normal,a:albedo"))
        assert f"| {scene} | {cells} |" in answers
    assert f"{measured['adaptive']['ratio']:.2f} of the error of even ones" in answers
    for spp, error in measured["many"]["relMSE"].items():
        assert f"{error:.2g}" in answers and f"| {int(spp):,} | {error:.2g} | {int(spp) * error:.3f} |" in farm
    noisy, clean = (measured["alpha"][f"RMSE {kind}"] for kind in ("noisy", "denoised"))
    assert f"from {noisy:.3f} to {clean:.3f}" in answers
    share = measured["infinite"]["share of pixels changed by more than a tenth"]
    assert f"OIDN alone changes {100 * share['OIDN alone']:.0f} % of the pixels" in answers and share["ngpt"] == 0
    assert f"by {100 * measured['groups']['gap by themselves']:.1f} % of its largest value" in answers
