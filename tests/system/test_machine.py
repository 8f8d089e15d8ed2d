"""What results record of where they were made, and the files they are written to."""

import json

import pytest

from ngpt.system.writing import write_json, write_text


def test_files_are_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"x²": 1})
    assert json.loads(path.read_text()) == {"x²": 1}
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"x": float("nan")})
    write_text(tmp_path / "a.md", "σ²\n")
    assert json.loads(path.read_text()) == {"x²": 1} and (tmp_path / "a.md").read_text(encoding="utf-8") == "σ²\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "a.md"]
