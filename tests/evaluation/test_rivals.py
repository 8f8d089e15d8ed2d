"""``bench.rivals``: what it reads off its cells, and that its rival is Mitsuba with the points that are named."""

import pytest

from bench.rivals import POINTS, RIVALS, mitsuba_scene, over, rows


def cell(render, spp, **ways):
    """A cell in which a way, K or the default, has (seconds, error); FLIP is ten times the error."""
    names = {"k1": "1 prefiltered", "k2": "2 clean", "default": "default"}
    values = {names[w]: {"seconds": s, "error": e, "FLIP": 10 * e} for w, (s, e) in ways.items()}
    return {"scene": "room", "size": "8x8", "render": render, "spp": spp, "seed": 1, "ways": values}


# Errors fall as 1 / seconds, but those of K = 1 to twice as much.
CELLS = [
    cell("default", 4, default=(2.0, 0.1)),
    cell("mitsuba", 4, k1=(1.0, 0.8), k2=(1.0, 0.4)),
    cell("mitsuba", 16, k1=(4.0, 0.2), k2=(4.0, 0.1)),
    cell("multijitter", 4, k1=(1.0, 0.4), k2=(1.0, 0.2)),
    cell("multijitter", 16, k1=(4.0, 0.1), k2=(4.0, 0.05)),
]


def test_rivals_choose_the_best_of_their_ways_at_the_same_time():
    mine = [CELLS[0]["ways"]["default"]]
    expected = {
        "Mitsuba + OIDN": 0.1 / 0.4,
        "Mitsuba + OIDN, K = 1 or 2": 0.1 / 0.2,
        "its best points, K = 1 or 2": 0.1 / 0.1,
    }
    for name, ratio in expected.items():
        assert over(mine, CELLS, *RIVALS[name]) == [(pytest.approx(ratio), "")] * 2
    (line,) = rows(CELLS)
    assert line == ["room 8x8", "4", "2.00", "0.25, 0.25", "0.50, 0.50", "1.00, 1.00", *3 * ["-, -"]]


FILTER = '<rfilter type="gaussian"><float name="stddev" value=".4"/></rfilter>'
SCENE = """<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective">{sampler}<film type="hdrfilm">{filter}</film></sensor>
<shape type="sphere"><emitter type="area"/></shape></scene>"""


@pytest.mark.parametrize("points", POINTS.values())
def test_mitsuba_has_the_points_and_a_box_filter(renderer, tmp_path, points):
    file, bare = tmp_path / "scene.xml", tmp_path / "bare.xml"
    file.write_text(SCENE.format(sampler='<sampler type="independent"/>', filter=FILTER))
    bare.write_text(SCENE.format(sampler="", filter=""))
    for name in (str(file), str(bare), "diffuse"):
        (sensor,) = mitsuba_scene(name, (16, 8), points).sensors()
        assert points in sensor.sampler().class_name().lower()
        assert "Box" in sensor.film().rfilter().class_name()
        assert list(sensor.film().size()) == [16, 8]
