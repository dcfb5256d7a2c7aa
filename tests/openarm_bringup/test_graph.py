# SPDX-License-Identifier: Apache-2.0
"""Graph files: what is accepted, what is refused and with which words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from openarm_bringup.supervision.draw import mermaid, text
from openarm_bringup.supervision.graph import graph_names, load_graph
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError

BASE = """
name: toy
scene: demo
seed: 3
nodes:
  bridge:
    module: toy.bridge
    params: {scene: "${scene}", seed: "${seed}", label: "run ${seed}", nested: {deep: {x: 1}}}
    ready: [{message: /joint_states}]
    offers: [/joint_states]
  arm:
    module: toy.arm
    needs: [bridge]
    uses: [/joint_states]
  hand: {module: toy.hand, needs: [bridge, arm]}
"""


def write(folder: Path, body: str, name: str = "toy.yaml") -> str:
    path = folder / name
    path.write_text(body)
    return str(path)


def refused(folder: Path, body: str, **kwargs: object) -> OpenArmError:
    with pytest.raises(OpenArmError) as caught:
        load_graph(write(folder, body), **kwargs)  # type: ignore[arg-type]
    return caught.value


def test_variables_keep_their_type_and_nested_parameters_are_joined_by_dots(tmp_path: Path) -> None:
    graph = load_graph(write(tmp_path, BASE))
    assert graph.node("bridge").params == {"scene": "demo", "seed": 3, "label": "run 3", "nested.deep.x": 1}


def test_overrides_come_before_substitution_and_set_comes_last(tmp_path: Path) -> None:
    graph = load_graph(
        write(tmp_path, BASE), overrides={"scene": "random", "seed": 8, "domain": None}, sets=["bridge.label=[1, 2]"]
    )
    assert graph.node("bridge").params["scene"] == "random"
    assert graph.node("bridge").params["seed"] == 8
    assert graph.node("bridge").params["label"] == [1, 2]
    assert graph.domain is None


class Depth(Config):
    x: int = 0
    y: float = 0.5


class Nested(Config):
    deep: Depth = Depth()


class Bridge(Config):
    scene: str = ""
    seed: int = 0
    label: tuple[str, ...] | str = ""
    nested: Nested = Nested()
    rate: float = 30.0


def test_the_configuration_of_a_node_is_that_of_its_parameters(tmp_path: Path) -> None:
    sets = ["bridge.nested.deep.y=2", "bridge.use_sim_time=true", "bridge.rate=null"]
    graph = load_graph(write(tmp_path, BASE), overrides={"scene": "random"}, sets=sets)
    assert graph.config("bridge", Bridge) == Bridge(
        scene="random", seed=3, label="run 3", nested=Nested(deep=Depth(x=1, y=2.0))
    )
    assert graph.config("arm", Bridge) == Bridge()
    assert "rate" not in graph.parameters("bridge")


def test_a_wrong_parameter_of_a_node_is_refused_by_its_name(tmp_path: Path) -> None:
    graph = load_graph(write(tmp_path, BASE), sets=["bridge.nested.deep.z=2"])
    with pytest.raises(OpenArmError, match=r"parameters of bridge in graph toy:nested\.deep\.z: unknown key"):
        graph.config("bridge", Bridge)


def test_levels_follow_the_needs(tmp_path: Path) -> None:
    assert load_graph(write(tmp_path, BASE)).levels() == (("bridge",), ("arm",), ("hand",))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("  hand: {", "  arm: {module: other}\n  hand: {", r"'arm' is given twice.*line 15"),
        (
            "needs: [bridge, arm]",
            "needs: [bridg]",
            "toy.yaml:nodes.hand.needs: unknown node 'bridg'; nodes are bridge, arm, hand",
        ),
        ("module: toy.bridge", "module: toy.bridge\n    needs: [hand]", "bridge → hand → arm → bridge is a circle"),
        ("needs: [bridge]", "needs: [arm]", "arm → arm is a circle"),
        ("{message: /joint_states}", "{message: /a, topic: /b}", "nodes.bridge.ready.0: give exactly one"),
        ("{message: /joint_states}", "{message: joint_states}", "must be an absolute name, such as /joint_states"),
        ("module: toy.arm", "modul: toy.arm", "nodes.arm.modul: unknown key"),
        ("seed: 3", "seed: -3", "seed: Input should be greater than or equal to 0, got -3"),
        ("scene: demo", "sene: demo", "sene: unknown key; valid keys: name, description, scene"),
        ('"run ${seed}"', '"run ${sed}"', r"params.label: unknown variable \${sed}; there are \${scene}, \${seed}"),
        ("module: toy.hand", "params_file: no.yaml, module: toy.hand", "nodes.hand.params_file: no.yaml is neither in"),
    ],
)
def test_faults_name_the_key_and_what_is_valid(tmp_path: Path, old: str, new: str, words: str) -> None:
    error = refused(tmp_path, BASE.replace(old, new))
    assert error.code == Code.CONFIG_INVALID
    assert "toy.yaml" in error.message
    assert re.search(words, error.message, re.DOTALL), error.message


@pytest.mark.parametrize(
    ("item", "words"),
    [
        ("arm", "expected node.param=value"),
        ("arm=3", "expected node.param=value"),
        ("leg.speed=3", "has no node 'leg'; its nodes are bridge, arm, hand"),
        ("arm.x=[1", "the value is not valid YAML"),
    ],
)
def test_wrong_set_is_refused(tmp_path: Path, item: str, words: str) -> None:
    error = refused(tmp_path, BASE, sets=[item])
    assert error.code == Code.INVALID_ARGUMENT
    assert words in error.message


def test_unknown_graph_lists_those_of_the_suite() -> None:
    with pytest.raises(OpenArmError, match=r"no graph 'simm'; give a file, or one of .*sim"):
        load_graph("simm")


def test_every_graph_that_grasps_leaves_recordings_of_what_failed() -> None:
    grasping = {name for name in graph_names() if "grasp" in load_graph(name).nodes}
    assert {"sim", "no_depth", "openarm_ros2"} <= grasping
    assert {name for name in graph_names() if "flight_recorder" in load_graph(name).nodes} == grasping


def test_extends_keeps_some_nodes_and_changes_others(tmp_path: Path) -> None:
    write(tmp_path, BASE)
    small = "extends: toy\nonly: [bridge, arm]\nscene: empty\nnodes: {arm: {params: {speed: 2.0}}}\n"
    graph = load_graph(write(tmp_path, small, "small.yaml"))
    assert graph.name == "toy" or graph.name == "small"
    assert list(graph.nodes) == ["bridge", "arm"]
    assert graph.node("bridge").params["scene"] == "empty"
    assert graph.node("arm").params == {"speed": 2.0}
    assert graph.node("arm").needs == ("bridge",)


def test_only_of_an_unknown_node_is_refused(tmp_path: Path) -> None:
    write(tmp_path, BASE)
    with pytest.raises(OpenArmError, match=r"small.yaml:only: unknown node 'leg'"):
        load_graph(write(tmp_path, "extends: toy\nonly: [leg]\n", "small.yaml"))


def test_parameter_file_comes_before_inline_parameters(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text(
        "/**: {ros__parameters: {a: 1, b: {c: 2}}}\narm: {ros__parameters: {a: 5, d: 6}}\n"
    )
    both = "module: toy.arm\n    params_file: p.yaml\n    params: {d: 7}"
    graph = load_graph(write(tmp_path, BASE.replace("module: toy.arm", both)))
    assert graph.node("arm").params == {"a": 5, "b.c": 2, "d": 7}


def test_drawings_show_who_gives_what_to_whom(tmp_path: Path) -> None:
    graph = load_graph(write(tmp_path, BASE))
    assert 'bridge -- "/joint_states" --> arm' in mermaid(graph)
    assert "/joint_states → arm" in text(graph)
    assert "after bridge, arm" in text(graph)


REAL = """
extends: real
nodes:
  openarm_hardware: {params: {motors: {hot: 70}, emulated: false}}
"""


@pytest.mark.requirement("R-10", "A-25")
def test_emulation_puts_a_simulation_in_place_of_motors_and_cameras_and_keeps_what_a_file_says(tmp_path: Path) -> None:
    graph = load_graph(write(tmp_path, REAL), emulate=True)
    assert not [name for name in graph.nodes if name.endswith("_camera")]
    assert graph.node("mujoco_bridge").params["controllers"] == "motors"
    params = graph.node("openarm_hardware").params
    assert (params["emulated"], params["motors.hot"]) == (True, 70)
    assert (graph.scene, graph.mount_seed) == ("demo", 1)
    real = load_graph(write(tmp_path, REAL))
    assert "mujoco_bridge" not in real.nodes
    assert [name for name in real.nodes if name.endswith("_camera")]
    assert real.node("openarm_hardware").params["emulated"] is False
    others = graph.nodes.keys() - {"mujoco_bridge"}
    assert others == {name for name in real.nodes if not name.endswith("_camera")}


def test_a_graph_without_an_emulation_is_refused_one(tmp_path: Path) -> None:
    with pytest.raises(OpenArmError, match=r"has no `emulate`.*real") as refused:
        load_graph(write(tmp_path, BASE), emulate=True)
    assert refused.value.code is Code.INVALID_ARGUMENT
