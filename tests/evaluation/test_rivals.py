"""``bench.rivals``: its rival is Mitsuba with the points that are named."""

import pytest

from bench.rivals import POINTS, mitsuba_scene

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
