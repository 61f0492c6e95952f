"""Damage to one file, of its bytes, its kind or its contents."""

import json
import os
import random
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from headway.store.checkpoint import checkpoint_bytes, load_latest

Damage = Callable[[Path, random.Random], str]
"""(file, draws) -> what was done to it."""
_ODD: tuple[Any, ...] = (
    None, True, -1, 0, 10**400, 2**63, 1e308, float("nan"), float("inf"), "", "text", "x" * 100_000,
    "\x1b[31m\n", [], {}, [None], {"a": [1]}, "../..", "/dev/zero",
)  # fmt: skip
_CELLS = (
    "", "nan", "-1", "0", "1e308", "inf", "9" * 400, "text", "x" * 100_000, "25:61:00", "-08:00:00",
    "99999:00:00", '"', "a,b", "\x1b[31m", "é", "20240231", "1.5", "A", "NULL",
)  # fmt: skip
_NUMBERS = (float("nan"), float("inf"), -1.0, 0.0, 1e308, -1e308, 1e-320, 2.0**63, 1e6)
_DEEP = "a very deep value"


def damage_file(path: Path, draws: random.Random) -> str:
    """Damage a file in a way that fits it; return what was done."""
    of_kind: dict[str, tuple[Damage, ...]] = {
        ".json": (_replace_value,),
        ".yaml": (_replace_value,),
        ".txt": (_change_table,),
        ".csv": (_change_table,),
        ".parquet": (_change_table,),
        ".pt": (_change_checkpoint,),
        ".zip": (_change_member, _encrypt, _bomb),
    }
    readable = path.is_file() and not path.is_symlink()
    own = of_kind.get(path.suffix, ()) if readable else ()
    damage = draws.choice(own if own and draws.random() < 0.6 else _OF_ANY)
    try:
        done = damage(path, draws)
    except Exception as error:  # a file that was damaged before raises whatever its reader raises
        done = f"{_cut(path, draws)} (not otherwise: {type(error).__name__})"
    return f"{path}: {done}"


def _cut(path: Path, draws: random.Random) -> str:
    if not path.is_file() or path.is_symlink():
        return _replace_by_text(path, draws)
    size = int(path.stat().st_size * draws.random())
    os.truncate(path, size)
    return f"cut to {size} bytes"


def _flip(path: Path, draws: random.Random) -> str:
    content = (
        bytearray(path.read_bytes() or b"0") if path.is_file() and not path.is_symlink() else bytearray(9)
    )
    places = [draws.randrange(len(content)) for _ in range(draws.choice((1, 1, 8, 64)))]
    for place in places:
        content[place] ^= 1 << draws.randrange(8)
    _clear(path)
    path.write_bytes(content)
    return f"bits flipped at {sorted(places)[:3]}"


def _empty(path: Path, draws: random.Random) -> str:
    _clear(path)
    path.write_bytes(b"")
    return "emptied"


def _replace_by_text(path: Path, draws: random.Random) -> str:
    _clear(path)
    content = draws.choice(
        (
            draws.randbytes(1000), b"[" * 100_000, b"{" * 100_000, b"\0" * 1000, b"null", b"\xff\xfe",
            b"- " * 100_000,
        )
    )  # fmt: skip
    path.write_bytes(content)
    return f"replaced by {content[:4]!r}... of {len(content)} bytes"


def _append(path: Path, draws: random.Random) -> str:
    if not path.is_file() or path.is_symlink():
        return _replace_by_text(path, draws)
    with path.open("ab") as stream:
        stream.write(draws.randbytes(100))
    return "100 bytes appended"


def _remove(path: Path, draws: random.Random) -> str:
    _clear(path)
    return "removed"


def _make_folder(path: Path, draws: random.Random) -> str:
    _clear(path)
    path.mkdir()
    return "a folder"


def _make_pipe(path: Path, draws: random.Random) -> str:
    _clear(path)
    os.mkfifo(path)
    return "a pipe"


def _make_link(path: Path, draws: random.Random) -> str:
    _clear(path)
    target = draws.choice(
        ("/dev/zero", "/dev/null", "nothing", path.name, "..", "/proc/self/mem", "/dev/full")
    )
    path.symlink_to(target)
    return f"a link to {target}"


_OF_ANY: tuple[Damage, ...] = (
    _cut, _flip, _flip, _empty, _replace_by_text, _append, _remove, _make_folder, _make_pipe, _make_link,
)  # fmt: skip


def _clear(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _replace_value(path: Path, draws: random.Random) -> str:
    """Replace, remove or rename one value of a JSON or YAML file, however deep."""
    is_json = path.suffix == ".json"
    content = json.loads(path.read_text()) if is_json else yaml.safe_load(path.read_text())
    places = list(_places(content))
    if not places:
        return _replace_by_text(path, draws)
    holder, key = draws.choice(places)
    value = draws.choice((*_ODD, _DEEP, "remove", "rename"))
    if value == "remove":
        del holder[key]
    elif value == "rename" and isinstance(holder, dict):
        holder[f"{key}s"] = holder.pop(key)
    else:
        holder[key] = value
    text = json.dumps(content) if is_json else yaml.safe_dump(content)
    deep = "[" * 100_000 + "]" * 100_000
    path.write_text(text.replace(f'"{_DEEP}"' if is_json else _DEEP, deep))
    return f"value {key}: {str(value)[:30]!r}"


def _places(content: Any) -> list[tuple[Any, Any]]:  # noqa: ANN401 - JSON
    items = (
        content.items()
        if isinstance(content, dict)
        else enumerate(content)
        if isinstance(content, list)
        else ()
    )
    return [place for key, inner in items for place in ((content, key), *_places(inner))]


def _change_table(path: Path, draws: random.Random) -> str:
    is_parquet = path.suffix == ".parquet"
    frame = pd.read_parquet(path) if is_parquet else pd.read_csv(path, dtype=str, keep_default_na=False)
    frame, done = _changed(frame, draws, is_parquet)
    if is_parquet:
        frame.to_parquet(path)
    else:
        frame.to_csv(path, index=False)
    return done


def _changed(frame: pd.DataFrame, draws: random.Random, typed: bool) -> tuple[pd.DataFrame, str]:
    column = draws.choice(list(frame.columns))
    row = draws.randrange(max(len(frame), 1))
    kind = draws.choice(
        ("cell", "cell", "cell", "column", "drop", "rename", "repeat", "rows", "none", "order")
    )
    values: tuple[Any, ...] = (*_CELLS, None)
    if typed and pd.api.types.is_numeric_dtype(frame[column].dtype):
        values = (*_NUMBERS, None) if draws.random() < 0.8 else values
    value = draws.choice(values)
    shown = f"{column}: {str(value)[:20]!r}"
    if kind == "cell":
        cells = frame[column].astype(object).tolist()
        cells[row] = value
        if typed and isinstance(value, str):
            cells = [str(cell) for cell in cells]
        return frame.assign(**{column: cells}), f"row {row}, {shown}"
    if kind == "column":
        return frame.assign(**{column: [value] * len(frame)}), f"column {shown}"
    if kind == "drop":
        return frame.drop(columns=column), f"column {column} dropped"
    if kind == "rename":
        return frame.rename(columns={column: f"{column} "}), f"column {column} renamed"
    if kind == "repeat":
        return pd.concat([frame, frame.iloc[row : row + 1]]), f"row {row} repeated"
    if kind == "rows":
        return frame.drop(index=frame.index[row : row + 1 + draws.randrange(5)]), f"rows from {row} dropped"
    if kind == "none":
        return frame.iloc[:0], "all rows dropped"
    return frame.sample(frac=1.0, random_state=draws.randrange(1000)), "rows in another order"


def _change_checkpoint(path: Path, draws: random.Random) -> str:
    """Change one array of a checkpoint, or remove a value, under a checksum that matches."""
    alone = path.with_name(f"{path.stem}-alone")
    alone.mkdir()
    shutil.copy(path, alone)
    try:
        _, state, _ = load_latest(alone)
    finally:
        shutil.rmtree(alone)
    state = dict(state)
    holder, key = draws.choice(_places(state))
    array = holder[key]
    kind = draws.choice(("nan", "shape", "type", "remove", "value"))
    if hasattr(array, "numpy"):
        array = array.numpy()
    if isinstance(array, np.ndarray) and kind in ("nan", "shape", "type") and array.size:
        if kind == "nan" and array.dtype.kind == "f":
            array = array.copy()
            array.flat[draws.randrange(array.size)] = draws.choice((np.nan, np.inf))
        elif kind == "shape":
            array = draws.choice((array.reshape(-1)[:-1], array[None], array.reshape(-1)[:0]))
        else:
            array = array.astype(draws.choice((np.int8, np.complex128, "S8", bool)))
        holder[key] = array
    elif kind == "remove":
        del holder[key]
    else:
        holder[key] = draws.choice((None, -1, 10**30, "text", [], {}, 1.5, np.zeros((2, 3))))
    path.write_bytes(checkpoint_bytes(state))
    return f"{kind} of {key}"


def _change_member(path: Path, draws: random.Random) -> str:
    """Damage one file in a zip, rename it, or store it twice."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = draws.choice(sorted(members))
    kind = draws.choice(("content", "content", "content", "rename", "folder", "twice", "method"))
    done = f"{kind} of {name}"
    if kind == "content":
        file = path.with_name("member.txt")
        file.write_bytes(members.pop(name))
        done = damage_file(file, draws).replace("member.txt", name)
        if file.is_file() and not file.is_symlink():
            members[name] = file.read_bytes()
        _clear(file)
    elif kind in ("rename", "folder"):
        members[f"../{name}" if kind == "rename" else f"inner/{name}"] = members.pop(name)
    with zipfile.ZipFile(
        path, "w", zipfile.ZIP_LZMA if kind == "method" else zipfile.ZIP_DEFLATED
    ) as archive:
        for each, content in members.items():
            archive.writestr(each, content)
        if kind == "twice":
            archive.writestr(name.upper(), members[name])
    return done


def _encrypt(path: Path, draws: random.Random) -> str:
    """Set the flag that says that files of the zip are encrypted."""
    content = bytearray(path.read_bytes())
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = content.find(mark)
        while place >= 0:
            content[place + offset] |= 1
            place = content.find(mark, place + 4)
    path.write_bytes(content)
    return "marked as encrypted"


def _bomb(path: Path, draws: random.Random) -> str:
    """Let one file of the zip unpack to very much, or claim so."""
    if draws.random() < 0.5:
        claiming = bytearray(path.read_bytes())
        place = claiming.find(b"PK\x01\x02")
        struct.pack_into("<I", claiming, place + 24, 2**32 - 2)
        path.write_bytes(claiming)
        return "its first file claims 4 GiB"
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["stops.txt"] = b"stop_id,stop_lat,stop_lon\n" + b"A,1,1\n" * 30_000_000
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return "its stops.txt unpacks to 180 MB"
