"""GPUDrive JSON: the real files, a hand-made one, and damaged ones."""

import copy
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.formats import Format, detect, read_scenes
from sim.gpudrive import parse_gpudrive
from sim.scene import LightState, ObjectType, RoadKind, Scene, SceneError
from sim.validate import check_scene
from tests import records


def _parse(content: Any) -> Scene:
    return parse_gpudrive(json.dumps(content, indent=1).encode(), source="made.json")


@pytest.mark.parametrize(
    ("scenario", "objects", "roads", "points"),
    [
        ("ef3a8f65142f41ac", 62, 157, 10_527),
        ("db4edc9bd0c9d18c", 81, 102, 5_388),
        ("bada21415c031740", 15, 177, 11_155),
    ],
)
def test_the_real_files(
    scenes_data: Path, scenario: str, objects: int, roads: int, points: int
) -> None:
    path = scenes_data / "gpudrive" / f"{scenario}.json"
    assert detect(path) is Format.GPUDRIVE
    (scene,) = read_scenes([path])
    assert scene.scenario_id == scenario
    assert (scene.objects, scene.steps, scene.current_step) == (objects, 91, 10)
    assert (len(scene.roads), sum(len(r.points) for r in scene.roads)) == (
        roads,
        points,
    )
    assert scene.valid[scene.sdc_index].all()
    assert not scene.position[~scene.valid].any()  # no -10000 is left
    assert any(road.kind is RoadKind.EDGE_BOUNDARY for road in scene.roads)


def test_every_field_arrives() -> None:
    scene = _parse(records.gpudrive())
    assert scene.scenario_id == "abc"
    assert (scene.dt, scene.current_step, scene.sdc_index) == (0.1, 10, 1)
    assert scene.object_ids.tolist() == [100, 101]
    assert scene.object_types.tolist() == [ObjectType.VEHICLE] * 2
    assert scene.valid.tolist() == [[s != 1 for s in range(12)]] * 2
    np.testing.assert_allclose(scene.position[1, 4], [2.0, 3.5, 1.0])
    np.testing.assert_allclose(scene.velocity[0, 3], [5.0, 0.0])
    np.testing.assert_allclose(scene.size[0, 0], [4.5, 2.0, 1.5])
    assert scene.tracks_to_predict == (0,)
    assert scene.objects_of_interest == (1, 0)
    edge, sign = scene.roads
    assert (edge.kind, edge.feature_id) == (RoadKind.EDGE_MEDIAN, 2)
    assert (sign.kind, len(sign.points)) == (RoadKind.STOP_SIGN, 1)
    assert scene.lights.lane_ids.tolist() == [1]
    assert scene.lights.states[0, :4].tolist() == [LightState.STOP, 0, LightState.GO, 0]
    np.testing.assert_allclose(scene.lights.stop_points, [[30.0, 0.0, 0.0]])


def test_the_first_versions_of_the_format_are_read() -> None:
    content = records.gpudrive()
    del content["metadata"], content["scenario_id"]
    content["objects"][0]["heading"][0] = 90.0
    for item in (*content["objects"], *content["roads"]):
        item.pop("id")
        item.pop("map_element_id", None)
    scene = _parse(content)
    assert scene.scenario_id == "scene"
    assert scene.sdc_index == 1
    assert scene.yaw[0, 0] == pytest.approx(np.pi / 2)
    assert [road.kind for road in scene.roads] == [
        RoadKind.EDGE_UNKNOWN,
        RoadKind.STOP_SIGN,
    ]


def test_a_short_scene_acts_at_its_last_step_but_one() -> None:
    assert _parse(records.gpudrive(steps=4) | {"tl_states": {}}).current_step == 2


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda c: c.pop("objects"), "missing required field `objects`"),
        (lambda c: c.update(objects=[]), "there is no object"),
        (lambda c: c.update(roads={}), "Expected `array`, got `object` - at `$.roads`"),
        (lambda c: c["metadata"].update(sdc_track_index=2), "SDC index 2 is not among"),
        (lambda c: c["objects"][1]["valid"].pop(), "object 1 has [12, 12, 12, 11]"),
        (lambda c: c["objects"][1].update(length="4"), "at `$.objects[1].length`"),
        (lambda c: c["objects"][1].update(length=0), "length or width is not positive"),
        (lambda c: c["objects"][1].update(type="tram"), "unknown object type 'tram'"),
        (lambda c: c["objects"][1].update(position=[]), "object 1 has [0, 12, 12, 12]"),
        (lambda c: c["objects"][0].update(valid=[]), "object 0 has no steps"),
        (lambda c: c["roads"][0].update(map_element_id=4), "unknown map_element_id 4"),
        (lambda c: c["roads"][1].update(type="river"), "unknown type 'river'"),
        (lambda c: c["tl_states"]["1"].update(state=["off", "go"]), "state 'off'"),
        (lambda c: c["tl_states"]["1"].update(state=["go"]), "of several lengths"),
        (lambda c: c["tl_states"]["1"].update(time_index=[0, 12]), "time index 12"),
        (lambda c: c["tl_states"].update(x=c["tl_states"]["1"]), "lane id 'x'"),
    ],
)
def test_what_is_wrong_is_named(change: Any, problem: str) -> None:
    content = records.gpudrive()
    change(content)
    with pytest.raises(SceneError, match=re.escape(problem)) as caught:
        _parse(content)
    assert str(caught.value).startswith("made.json: ")
    assert "\n" not in str(caught.value)


def test_nan_is_not_json() -> None:
    content = records.gpudrive()
    content["objects"][0]["heading"][3] = float("nan")
    with pytest.raises(SceneError, match=r"broken JSON at line \d+ column \d+ "):
        _parse(content)


def test_broken_json_says_line_and_column() -> None:
    text = b'{\n "roads": [],\n "objects": [} ]\n}'
    with pytest.raises(SceneError, match=r"line 3 column 14 \(byte 29\)"):
        parse_gpudrive(text, source="made.json")
    with pytest.raises(SceneError, match=r"line 2 column 11 \(byte 12\): .*start byte"):
        parse_gpudrive(b'{\n "name": "\xff"}', source="made.json")


def test_deep_nesting_is_refused() -> None:
    with pytest.raises(SceneError, match="recursion"):
        parse_gpudrive(b'{"more":' + b"[" * 100_000, source="made.json")


def test_truncation_at_every_byte() -> None:
    text = json.dumps(records.gpudrive(objects=1, steps=3), indent=1).encode()
    for cut in range(len(text)):
        with pytest.raises(SceneError, match=rf"broken JSON at .*\(byte {cut}\)"):
            parse_gpudrive(text[:cut], source="made.json")


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key) of a JSON value."""
    keys: Any = value if isinstance(value, dict) else range(len(value))
    for key in keys:
        yield value, key
        if isinstance(value[key], (dict, list)):
            yield from _places(value[key])


_CONTENT = records.gpudrive(objects=2, steps=3)
_WRONG = st.sampled_from(
    [None, True, -1, 0, 4, 2**70, -1e300, 1e-300, "", "1", [], [[]], {}, {"x": 0}]
)


@given(st.data())
def test_wrong_values_anywhere(data: st.DataObject) -> None:
    """A sound scene or a SceneError, nothing else."""
    content = copy.deepcopy(_CONTENT)
    places = list(_places(content))
    for _ in range(data.draw(st.integers(1, 2))):
        container, key = data.draw(st.sampled_from(places))
        container[key] = data.draw(_WRONG)
    try:
        scene = _parse(content)
    except SceneError as error:
        assert str(error).startswith("made.json: ")
    else:
        assert check_scene(scene) is scene


@given(st.data())
def test_flipped_bits(data: st.DataObject) -> None:
    text = bytearray(json.dumps(_CONTENT).encode())
    for bit in data.draw(st.lists(st.integers(0, 8 * len(text) - 1), min_size=1)):
        text[bit // 8] ^= 1 << (bit % 8)
    try:
        check_scene(parse_gpudrive(bytes(text), source="here"))
    except SceneError as error:
        assert str(error).startswith("here: ")
