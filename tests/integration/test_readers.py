"""Damaged and odd files: each reader takes them, or refuses them with an InputError that names the file, in seconds.

A further format is one more entry of `READERS`: a name, how to write a valid file, the reader, and what to change.
The changes come from a generator with a fixed seed, so that every run meets the same files.
"""

from __future__ import annotations

import io
import json
import random
import re
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
import yaml

from drakerock.errors import InputError
from drakerock.exploration.problems import make_noisy_loading, make_noisy_table
from drakerock.exploration.table import ResponseTable
from drakerock.loading.plan_file import load_plan
from drakerock.loading.recording import Recording, Visual, load_recording, save_recording
from drakerock.loading.scenario import load_scenario
from drakerock.loading.signal_table import load_signals
from drakerock.npz import save_arrays
from drakerock.rocks.config import SiteConfig
from drakerock.rocks.state import ContactMemory, PileState, load_pile, save_pile
from drakerock.study.analysis import _read_confirmation
from drakerock.study.db import read_outcome, read_study
from drakerock.study.schema import load_study

N_INPUTS = 220
MAX_SECONDS = 5.0
ROOT = Path(__file__).parents[2]

Change = Callable[[bytes, random.Random], bytes]

_TOKENS = [
    b"\0", b"\xff", b"\xfe", b"\xef\xbb\xbf", b"\xc3\xa9", b"NaN", b"-inf", b"1e999", b"1e300", b"-1", b"0", b"9" * 400,
    b"0.5", b"1,5", b"2024-05-01", b"null", b"true", b"''", b'"', b",", b";", b"\t", b"\r", b"\n", b"#", b"[", b"]",
    b"{", b"}", b":", b": ", b"- ", b"sep=;\n", b" ",
]  # fmt: skip
_VALUES: list[Any] = [
    None, True, 0, -1, 2**40, 10**30, 0.5, -2.5, 1e300, float("nan"), float("inf"), "", "x", "1", "$_{$", [], [1], [[]],
    {}, {"a": 1}, [None, "x"], [1, 2, 3, 4, 5, 6, 7],
]  # fmt: skip


def change_bytes(data: bytes, rng: random.Random) -> bytes:
    """Flip, cut, double, insert and exchange, up to four times."""
    for _ in range(rng.randint(1, 4)):
        at, end = sorted(rng.randrange(len(data) + 1) for _ in range(2))
        end = min(end, at + rng.choice([1, 4, 40, 4000]))
        kind = rng.randrange(7)
        if kind == 0 and data:
            place = rng.randrange(len(data))
            data = data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :]
        elif kind == 1:
            data = data[:at] + data[end:]
        elif kind == 2:
            data = data[:end] + data[at:end] + data[end:]
        elif kind == 3:
            data = data[:at] + rng.choice(_TOKENS) + data[at:]
        elif kind == 4:
            words = list(re.finditer(rb"[\w.+-]+", data))
            if words:
                word = rng.choice(words)
                data = data[: word.start()] + rng.choice(_TOKENS) + data[word.end() :]
        elif kind == 5:
            lines = data.split(b"\n")
            i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
            lines[i], lines[j] = lines[j], lines[i]
            data = b"\n".join(lines)
        elif rng.random() < 0.3:
            data = data[:at]
    return data


def change_value(tree: Any, rng: random.Random) -> Any:
    """Exchange, remove or rename something in a tree of lists and dictionaries."""
    if isinstance(tree, dict | list) and tree and rng.random() < 0.85:
        keys = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
        key, copy = rng.choice(keys), tree.copy()
        if rng.random() < 0.15:
            del copy[key]
        elif isinstance(tree, dict) and rng.random() < 0.05:
            copy[str(key) + "_"] = copy.pop(key)
        else:
            copy[key] = change_value(tree[key], rng)
        return copy
    return rng.choice(_VALUES)


def change_json(data: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.4:
        return change_bytes(data, rng)
    return json.dumps(change_value(json.loads(data), rng)).encode()


def change_yaml(data: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.5:
        return change_bytes(data, rng)
    return yaml.safe_dump(change_value(yaml.safe_load(data), rng)).encode()


def change_array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    kind = rng.randrange(8)
    if kind == 0:
        return array[: rng.randrange(len(array) + 1)] if array.ndim else array.reshape(1)
    if kind == 1:
        return array.astype(rng.choice(["f4", "i8", "u1", "?", "U5", "c16"]))
    if kind == 2:
        return array.reshape(-1)
    if kind == 3:
        return array[..., None]
    if kind == 4:
        return np.array(rng.choice([0, 1.5, "x", True]))
    if kind == 5:
        return array[:0]
    array = array.copy()
    if array.size and array.dtype.kind in "fiu":
        array.flat[rng.randrange(array.size)] = rng.choice(
            [-7, 0, 100, 2**30] + [np.nan] * (array.dtype.kind == "f")
        )
    return array


def change_npz(data: bytes, rng: random.Random) -> bytes:
    """Change bytes, or, with a checksum that is right, an array or the header."""
    if rng.random() < 0.3:
        return change_bytes(data, rng)
    with np.load(io.BytesIO(data)) as stored:
        arrays = {name: stored[name] for name in stored.files}
    head = json.loads(str(arrays.pop("header")))
    version, header = head["version"], head["header"]
    name = rng.choice(list(arrays))
    kind = rng.randrange(6)
    if kind == 0:
        header = change_value(header, rng)
    elif kind == 1:
        version = rng.choice(_VALUES)
    elif kind == 2:
        del arrays[name]
    else:
        arrays[name] = change_array(arrays[name], rng)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "changed.npz"
        save_arrays(path, head["format"], version, header, arrays)
        return path.read_bytes()


def change_parquet(data: bytes, rng: random.Random) -> bytes:
    """Change bytes, or a column's type, name, order or values."""
    if rng.random() < 0.4:
        return change_bytes(data, rng)
    table = pyarrow.parquet.read_table(io.BytesIO(data))
    i = rng.randrange(table.num_columns)
    name, column = table.column_names[i], table.column(i)
    n = table.num_rows
    odd = [
        lambda: column.cast(pa.string()),
        lambda: column.cast(pa.string()).dictionary_encode(),
        lambda: column.dictionary_encode(),
        lambda: column.cast(pa.float32(), safe=False),
        lambda: pa.nulls(n),
        lambda: pa.array([None] * n, pa.float64()),
        lambda: pa.array([True] * n),
        lambda: pa.array(range(n), pa.date32()),
        lambda: pa.array(range(n), pa.timestamp("ns")),
        lambda: pa.array(range(n), pa.duration("us")),
        lambda: pa.array([[1.0]] * n),
        lambda: pa.array([{"a": 1}] * n),
        lambda: pa.array([b"\xff"] * n),
        lambda: pa.array([1] * n, pa.decimal128(38, 5)),
        lambda: pa.array([2**60] * n),
        lambda: pa.array([rng.choice([1e300, float("nan"), float("inf"), -1.0, 0.5])] * n),
        lambda: pa.array(["1,5"] * n),
    ]
    try:
        changed = rng.choice(odd)()
    except pa.ArrowException:
        changed = column
    kind = rng.randrange(4)
    if kind == 0:
        table = table.remove_column(i)
    elif kind == 1:
        table = table.append_column(rng.choice([name, name.upper(), f" {name}", "", "Point"]), changed)
    else:
        table = table.set_column(i, name, changed)
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(table, buffer)
    return buffer.getvalue()


def make_table_csv(folder: Path) -> Path:
    X = make_noisy_loading().problem.unscale(np.random.default_rng(0).uniform(-1, 1, (12, 4)))
    return make_noisy_table(X, np.random.default_rng(0), 3, n_validation=3).save(folder / "responses.csv")


def make_table_parquet(folder: Path) -> Path:
    return ResponseTable.load(make_table_csv(folder)).save(folder / "responses.parquet")


def make_loadings(folder: Path) -> Path:
    rows = ["point;role;loading;status;alpha;beta;gamma;kappa;production;damage;debris;production_se"]
    rows += [f"a{i};Train;{j};done;1,1;0,5;0;1;{100 + j},25;0,5;{j};" for i in range(4) for j in range(3)]
    path = folder / "loadings.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def make_pile(n: int = 5) -> PileState:
    rng = np.random.default_rng(0)
    q = rng.normal(size=(n, 4))
    contacts = ContactMemory(np.array([[0, 1], [1, -1]]), np.ones((2, 3)), np.ones((2, 3)), np.zeros(n, bool))
    return PileState(
        rng.normal(size=(n, 3)), q / np.linalg.norm(q, axis=1)[:, None], np.zeros((n, 6)), np.zeros(n, int), np.ones(n),
        np.zeros(n, bool), {"seed": 1}, contacts,
    )  # fmt: skip


def make_pile_file(folder: Path) -> Path:
    save_pile(make_pile(), folder / "pile.npz")
    return folder / "pile.npz"


def make_recording_file(folder: Path) -> Path:
    pile, triangles = make_pile(), np.array([[0, 1, 2], [0, 1, 3]], np.int32)
    corners = np.eye(4, 3, dtype=np.float32)
    recording = Recording(
        times=np.arange(3.0), modes=np.arange(3), bodies=("bucket",), X_WBs=np.ones((3, 1, 7), np.float32),
        visuals=(Visual(0, corners, triangles, np.ones(4, np.float32)),), rock_shapes=((np.eye(4, 3), triangles),),
        rock_shape=pile.shape, rock_size=pile.size, rock_fixed=pile.fixed, X_WRs=np.hstack([pile.q_WRs, pile.p_WRs]),
        move_frame=np.array([1, 2], np.int32), move_rock=np.array([4, 0], np.int32),
        move_pose=np.ones((2, 7), np.float32), site=SiteConfig(), notes={"title": "x"},
    )  # fmt: skip
    save_recording(recording, folder / "recording.npz")
    return folder / "recording.npz"


def make_plan_file(folder: Path) -> Path:
    data = json.loads((ROOT / "notebooks/data/cycle/plan.json").read_text())
    # Fewer cells: what is odd in one of ten thousand is found as well in one of a hundred.
    seen = data["height_field"]
    data["height_field"] = seen | {
        "x": seen["x"][:6],
        "y": seen["y"][:4],
        "h": [row[:4] for row in seen["h"][:6]],
    }
    path = folder / "plan.json"
    path.write_text(json.dumps(data))
    return path


def make_study_json(folder: Path) -> Path:
    study = load_study(ROOT / "studies/smoke.yaml")
    data = {"name": "x", "seed": 1, "problem": study.problem.model_dump(mode="json")}
    path = folder / "study.json"
    path.write_text(json.dumps(data | {"study": study.model_dump(mode="json")}))
    make_table_csv(folder)
    return path


def make_confirmation(folder: Path) -> Path:
    problem = make_noisy_loading().problem
    row: dict[str, Any] = dict.fromkeys(problem.variable_names, 0.5) | {"failure": ""}
    for name in problem.objective_names:
        row |= dict.fromkeys(
            (f"{name}_{k}" for k in ("predicted", "predicted_std", "simulated", "simulated_se")), 1.0
        )
    path = folder / "confirmation.json"
    path.write_text(json.dumps([row, row]))
    return path


def copy(source: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / Path(source).name
        path.write_bytes((ROOT / source).read_bytes())
        return path

    return make


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        name: of the format.
        make: writes a valid file into a folder, and returns its path.
        read: the reader.
        change: returns a changed file's bytes.
    """

    name: str
    make: Callable[[Path], Path]
    read: Callable[[Path], Any]
    change: Change


READERS = [
    Reader("table csv", make_table_csv, ResponseTable.load, change_bytes),
    Reader("table of loadings csv", make_loadings, ResponseTable.load, change_bytes),
    Reader("table parquet", make_table_parquet, ResponseTable.load, change_parquet),
    Reader("problem json", make_study_json, lambda path: ResponseTable.load(path.parent), change_json),
    Reader("study json", make_study_json, lambda path: read_study(path.parent), change_json),
    Reader(
        "confirmation json", make_confirmation,
        lambda path: _read_confirmation(path, make_noisy_loading().problem), change_json,
    ),
    Reader("outcome json", copy("notebooks/data/cycle/outcome.json"), read_outcome, change_json),
    Reader("signals parquet", copy("notebooks/data/cycle/signals.parquet"), load_signals, change_parquet),
    Reader("plan json", make_plan_file, load_plan, change_json),
    Reader("pile npz", make_pile_file, load_pile, change_npz),
    Reader("recording npz", make_recording_file, load_recording, change_npz),
    Reader("scenario yaml", copy("studies/small.yaml"), load_scenario, change_yaml),
    Reader("study yaml", copy("studies/smoke.yaml"), load_study, change_yaml),
]  # fmt: skip


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
@pytest.mark.filterwarnings("ignore")
def test_a_changed_file_is_read_or_refused(reader, tmp_path):
    path = reader.make(tmp_path)
    valid = path.read_bytes()
    reader.read(path)
    rng = random.Random(reader.name)
    for number in range(N_INPUTS):
        path.write_bytes(reader.change(valid, rng))
        start, message = time.process_time(), path.name
        try:
            reader.read(path)
        except InputError as error:
            message = str(error)
        except Exception as error:
            raise AssertionError(f"{reader.name}, input {number}: {type(error).__name__}: {error}") from error
        assert time.process_time() - start < MAX_SECONDS, f"{reader.name}, input {number}"
        assert str(tmp_path) in message or path.name in message, f"{reader.name}, input {number}: {message}"


def test_there_are_enough_inputs():
    assert len(READERS) * N_INPUTS >= 2000
