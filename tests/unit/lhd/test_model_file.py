"""What a machine's file must have: each fault is an InputError that tells file, line and what to write, and soon."""

from __future__ import annotations

import logging
import re
import time
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant

from drakerock.errors import InputError
from drakerock.lhd import tracing
from drakerock.lhd.config import FunctionConfig, MachineConfig
from drakerock.lhd.kinematics import make_kinematics
from drakerock.lhd.model import Machine, add_machine
from drakerock.lhd.model_file import check_machine_file
from drakerock.resources import find_data
from drakerock.rocks.drake.ball_constraints import read_ball_constraints

from .mutations import mutate, use

LINE = r"changed\.sdf:\d+: "
LIMITS = r"<lower>[^<]*</lower><upper>[^<]*</upper>"
BUSHING = "".join(
    f"<drake:bushing_{key}>{value}</drake:bushing_{key}>"
    for key, value in {
        "frameA": "tip",
        "frameC": "floor",
        "torque_stiffness": "0 0 0",
        "torque_damping": "0 0 0",
        "force_stiffness": "1 1 1",
        "force_damping": "0 0 0",
    }.items()
)


def write_sdf(folder: Path, *changes: tuple[str, str]) -> str:
    """Write a changed copy of the small machine's file, return its path."""
    text = find_data("models", "lhd_small", "lhd_small.sdf").read_text()
    for pattern, new in changes:
        text, count = re.subn(pattern, new, text)
        assert count, pattern
    file = folder / "changed.sdf"
    file.write_text(text)
    return str(file)


def in_joint(name: str, pattern: str) -> str:
    """Return a pattern that finds `pattern` in a joint; what stands before it is group 1."""
    return rf'(<joint name="{name}"(?:(?!</joint>).)*?){pattern}'


def make(file: str, **options) -> tuple[MultibodyPlant, Machine]:
    plant = MultibodyPlant(0.01)
    machine = add_machine(plant, MachineConfig(model=file, **options))
    plant.Finalize()
    return plant, machine


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('<link name="boom">', '<link name="beam">'), "boom"),
        ((r'<frame name="tip"', '<frame name="nose"'), r'missing <frame name="tip">'),
        (
            (r'<joint name="bucket_joint"', '<joint name="bucket_hinge"'),
            r'missing <joint name="bucket_joint">',
        ),
        (("</model>", ""), r"changed\.sdf:\d+: no valid XML"),
        (("</model>", '</model><model name="other"/>'), LINE + "<sdf> has to hold one <model>"),
        (('<model name="lhd_small">', '<model name="o"><model name="m">'), "no valid XML"),
        (("</model>", '<model name="inner"/></model>'), LINE + "a machine is one <model> without <model>"),
        (
            ("</model>", "<include><uri>x</uri></include></model>"),
            LINE + "a machine is one <model> without <include>",
        ),
        (
            ('xmlns:drake="drake.mit.edu"', 'xmlns:drake="drake.mit.edu" xmlns:d="drake.mit.edu"'),
            LINE + "Drake knows its elements by the prefix drake: alone",
        ),
        (
            (
                "</model>",
                '<joint name="extra" type="revolute"><parent>boom</parent><child>lift_left_rod</child><axis>'
                "<xyz>0 1 0</xyz></axis></joint></model>",
            ),
            LINE + "joint 'extra' closes a loop of joints at 'lift_left_rod'",
        ),
        (
            ("</model>", f"<drake:linear_bushing_rpy>{BUSHING}</drake:linear_bushing_rpy></model>"),
            "linear_bushing_rpy> gives way",
        ),
        (
            (
                in_joint("lift_left_barrel_joint", "</joint>"),
                r'\1<drake:mimic joint="boom_joint" multiplier="1" offset="0"/></joint>',
            ),
            "no ball constraints",
        ),
        (
            (r"<drake:ball_constraint_p_AP>[^<]*</drake:ball_constraint_p_AP>", ""),
            r"changed\.sdf.*ball_constraint_p_AP",
        ),
        ((r"(<drake:ball_constraint_p_BQ>)[-\d.]+ ", r"\1-2.136 "), "isn't closed"),
        (
            (in_joint("bucket_joint", r"<velocity>[^<]*</velocity>"), r"\1"),
            LINE + "joint 'bucket_joint' has no limit of velocity",
        ),
        (
            (in_joint("boom_joint", r"<velocity>[^<]*<"), r"\1<velocity>-1<"),
            "joint 'boom_joint' has no limit of velocity",
        ),
        (
            (in_joint("boom_joint", r"<effort>[^<]*</effort>"), r"\1"),
            LINE + "joint 'boom_joint' has no limit of effort",
        ),
        (
            (in_joint("boom_joint", r"<effort>[^<]*</effort>"), r"\1<effort>0</effort>"),
            LINE + "joint 'boom_joint' has no actuator",
        ),
        (
            (in_joint("tilt_rod_joint", r"<effort>0</effort>"), r"\1"),
            LINE + "joint 'tilt_rod_joint' is no motor",
        ),
        (
            (in_joint("boom_joint", r"<drake:controller_gains [^>]*>"), r"\1"),
            LINE + "joint 'boom_joint' has no velocity gain",
        ),
        (
            (in_joint("articulation", r"<drake:controller_gains [^>]*>"), r"\1"),
            LINE + "joint 'articulation' holds no angle",
        ),
        (
            (in_joint("wheel_rear_left_joint", r"<effort>"), r"\1<effort>9"),
            LINE + "joint 'wheel_rear_left_joint' and",
        ),
        (
            (in_joint("boom_joint", "<parent>front_unit"), r"\1<parent>rear_unit"),
            LINE + "joint 'boom_joint' joins rear_unit",
        ),
        (
            (in_joint("bucket_joint", "<xyz>0 1 0"), r"\1<xyz>0 -1 0"),
            LINE + "joint 'bucket_joint' turns about 0 -1 0",
        ),
        (
            (in_joint("bucket_joint", "<xyz>0 1 0"), r"\1<xyz>0 0 1"),
            LINE + "joint 'bucket_joint' turns about 0 0 1",
        ),
        (
            (
                in_joint("bucket_joint", "<axis><xyz>0 1 0"),
                r"\1<pose>0 0 0 0 0 1.57079632679</pose><axis><xyz>1 0 0",
            ),
            "joint 'bucket_joint' turns about",
        ),
        (
            (r'(?s)(<link name="boom">.*?)<inertial>.*?</inertial>', r"\1"),
            LINE + "link 'boom' has no <inertial>",
        ),
        ((r'(?s)(<link name="boom">.*?)<mass>.*?</mass>', r"\1"), LINE + "link 'boom' has no <inertial>"),
        (
            (r'(?s)(<link name="boom">.*?)<mass>.*?</mass>', r"\1<mass>0</mass>"),
            LINE + "<inertial> has no <mass> above 0",
        ),
        ((r'(?s)(<link name="boom">.*?<ixx>)[^<]*<', r"\g<1>1e9<"), "boom"),
        (
            (r'(?s)(<link name="wheel_rear_left">.*?)<collision.*?</collision>', r"\1"),
            LINE + "link 'wheel_rear_left' has no <coll",
        ),
        (
            (r'(?s)<collision name="bucket_\d">.*?</collision>', ""),
            LINE + "link 'bucket' has no <collision> but pad_",
        ),
        ((r'<frame name="profile_2".*?</frame>', ""), LINE + r"frame 'profile_3' stands behind a gap"),
        ((r'<frame name="profile_[2-9]".*?</frame>', ""), LINE + r"frames profile_0\.\.1 are no outline"),
        ((r'(<frame name="floor".*?<pose>0 0) -', r"\1 "), LINE + "frame 'floor' has to stand below"),
        (
            (r'<frame name="tip" attached_to="bucket"', '<frame name="tip" attached_to="boom"'),
            LINE + "frame 'tip' is attached",
        ),
        ((r'(<frame name="tip".*?<pose>)[-\d.]+ ', r"\g<1>0.1 "), LINE + "frame 'tip' is misplaced"),
        ((in_joint("boom_joint", "revolute"), r"\1prismatic"), LINE + "joint 'boom_joint' is prismatic"),
        ((in_joint("tilt_rod_joint", LIMITS), r"\1"), "the bucket meets no stop|toggles"),
        ((in_joint("lift_(?:left|right)_rod_joint", LIMITS), r"\1"), "the boom meets no stop|toggles"),
    ],
)
def test_faults_are_told_soon(tmp_path, change, message):
    file = write_sdf(tmp_path, change)
    start = time.process_time()
    with pytest.raises(InputError, match=message) as error:
        make_kinematics(*make(file))
    assert time.process_time() - start < 5
    assert "\n" not in str(error.value)


def test_direct_drives_without_stops_are_told_soon(tmp_path):
    """No linkage at all, and no stops: nothing ends the tracing but its own bounds."""
    no_loops = (r"(?s)<drake:ball_constraint>.*?</drake:ball_constraint>", "")
    start = time.process_time()
    with pytest.raises(InputError, match="the boom meets no stop"):
        make_kinematics(*make(write_sdf(tmp_path, no_loops)))
    limits = (in_joint("boom_joint", "<limit>"), r"\1<limit><lower>0.5</lower><upper>2.2</upper>")
    with pytest.raises(InputError, match="the bucket meets no stop"):
        make_kinematics(*make(write_sdf(tmp_path, no_loops, limits)))
    assert time.process_time() - start < 5


@pytest.mark.parametrize(
    "change",
    [('xmlns:drake="drake.mit.edu"', 'xmlns:drake="elsewhere"'), (' xmlns:drake="drake.mit.edu"', "")],
)
def test_loops_are_those_of_the_plant_whatever_the_namespace(tmp_path, change):
    plant, machine = make(write_sdf(tmp_path, change))
    assert len(machine.loops) == plant.num_constraints() == 6
    assert (
        machine.loops
        == check_machine_file(
            MachineConfig(model=str(find_data("models", "lhd_small", "lhd_small.sdf")))
        ).loops
    )


def test_loops_are_the_files(model):
    """The points, to the last bit, as the file's text has them."""
    text = find_data("models", "lhd", "lhd.sdf").read_text()

    def find(key: str) -> list[str]:
        return re.findall(rf"<drake:ball_constraint_{key}>([^<]*)<", text)

    def read(key: str) -> list[tuple[float, ...]]:
        return [tuple(float(word) for word in words.split()) for words in find(key)]

    _, plant, _, machine = model
    found = [(loop.body_A, loop.p_AP, loop.body_B, loop.p_BQ) for loop in machine.loops]
    assert found == list(zip(find("body_A"), read("p_AP"), find("body_B"), read("p_BQ"), strict=True))
    balls = read_ball_constraints(plant)
    assert [(ball.body_A.name(), ball.body_B.name()) for ball in balls] == [(a, b) for a, _, b, _ in found]


def test_config_gives_the_limits_that_the_file_lacks(tmp_path):
    file = write_sdf(tmp_path, (in_joint("boom_joint", r"<velocity>[^<]*</velocity>"), r"\1"))
    _, machine = make(file, boom=FunctionConfig(velocity=0.7))
    assert machine.boom.velocity == 0.7


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (
            (in_joint("tilt_rod_joint", "<dynamics>"), r"\1<dynamics><friction>900</friction>"),
            "in dynamics: friction",
        ),
        (
            (
                in_joint("tilt_barrel_joint", "</axis>"),
                r'\1<mimic joint="boom_joint"><multiplier>1</multiplier><offset>0</offset>'
                "<reference>0</reference></mimic></axis>",
            ),
            "in axis: mimic",
        ),
        (
            (in_joint("tilt_rod_joint", "<limit>"), r"\1<limit><stiffness>1e5</stiffness>"),
            "in limit: stiffness",
        ),
        (
            (in_joint("tilt_rod_joint", "</joint>"), r'\1<sensor name="s" type="force_torque"/></joint>'),
            "joint: sensor",
        ),
        (
            (
                '(<collision name="bucket_1">.*?)</collision>',
                r"\1<surface><bounce><restitution_coefficient>1</restitution_coefficient></bounce></surface></collision>",
            ),
            "in surface: bounce",
        ),
        ((in_joint("boom_joint", ' p="0"'), r'\1 p="5"'), "p of joint 'boom_joint' is ignored"),
    ],
)
def test_what_has_no_effect_is_told(tmp_path, caplog, change, what):
    with caplog.at_level(logging.WARNING, logger="drakerock"):
        _, machine = make(write_sdf(tmp_path, change))
    (line,) = machine.ignored
    assert what in line
    assert re.search(r"changed\.sdf:\d+: ", line)
    assert line in caplog.text


@pytest.mark.parametrize("name", ["lhd", "lhd_small"])
def test_nothing_in_the_shipped_machines_is_without_effect(name):
    assert check_machine_file(MachineConfig(model=f"package://drakerock/{name}/{name}.sdf")).ignored == ()


@pytest.mark.parametrize("content", [None, "", "[[1, 2], [3, 4]]", "[[0, 1, 2], [1, NaN, 3]]", "{}"])
def test_a_cache_that_cannot_be_read_is_no_error(tmp_path, monkeypatch, content, model):
    monkeypatch.setattr(tracing, "user_cache_path", lambda _: tmp_path)
    monkeypatch.setattr(tracing, "trace_range", lambda *_: np.array([[0.0, 1.0, 2.0], [0.1, 1.0, 2.0]]))
    _, plant, _, machine = model
    fresh = tracing.find_range(plant, machine, 1.0, 1.0)
    (file,) = (tmp_path / "machines").iterdir()
    if content is None:
        file.unlink()
        file.mkdir()
    else:
        file.write_text(content)
    np.testing.assert_array_equal(tracing.find_range(plant, machine, 1.0, 1.0), fresh)


def test_the_cache_returns_the_same_bits_and_knows_the_machine(tmp_path, monkeypatch):
    monkeypatch.setattr(tracing, "user_cache_path", lambda _: tmp_path / "cache")
    monkeypatch.setattr(tracing, "_GRID_STEP", 0.4)
    plant, machine = make(write_sdf(tmp_path))
    first = make_kinematics(plant, machine)
    monkeypatch.setattr(tracing, "trace_range", lambda *_: pytest.fail("traced again"))
    again = make_kinematics(*make(write_sdf(tmp_path, ("<mass>", "<mass>1"))))
    for field in first.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, field), getattr(first, field))
    shorter = write_sdf(tmp_path, (in_joint("tilt_rod_joint", r"<upper>[\d.]+"), r"\1<upper>0.05"))
    with pytest.raises(pytest.fail.Exception, match="traced again"):
        make_kinematics(*make(shorter))


def test_random_changes_are_used_or_refused(tmp_path, monkeypatch):
    """75 files at random: used, or refused by an InputError that begins with the file; none takes long."""
    monkeypatch.setattr(tracing, "_GRID_STEP", 0.5)
    logging.disable(logging.WARNING)
    file, used, told = tmp_path / "random.sdf", 0, []
    for seed in range(75):
        file.write_text(mutate(np.random.default_rng(seed)), encoding="utf-8")
        start = time.process_time()
        try:
            use(file)
            used += 1
        except InputError as error:
            told.append(str(error))
        assert time.process_time() - start < 5, seed
    logging.disable(logging.NOTSET)
    assert 20 < used < 60
    assert all(text.startswith((str(file), "the machine can't reach")) for text in told)
