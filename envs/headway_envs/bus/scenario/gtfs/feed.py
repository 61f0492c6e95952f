"""Files of a GTFS feed, a folder or a zip file, as data frames of text."""

import csv
import io
import lzma
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyarrow import csv as arrow_csv

from headway.contracts import HeadwayError

Floats = NDArray[np.float64]

REQUIRED = {
    "stops": ("stop_id", "stop_lat", "stop_lon"),
    "routes": ("route_id", "route_type"),
    "trips": ("route_id", "service_id", "trip_id"),
    "stop_times": ("trip_id", "arrival_time", "stop_id", "stop_sequence"),
}
"""Required files and their required columns."""
_OPTIONAL = {
    "stops": ("stop_name", "parent_station"),
    "routes": ("agency_id", "route_short_name", "route_long_name"),
    "trips": ("direction_id", "block_id"),
    "stop_times": ("departure_time", "shape_dist_traveled"),
    "calendar": (
        *("service_id", "monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday"),
        *("start_date", "end_date"),
    ),
    "calendar_dates": ("service_id", "date", "exception_type"),
    "frequencies": ("trip_id", "start_time", "end_time", "headway_secs"),
    "agency": ("agency_id", "agency_name"),
    "feed_info": ("feed_publisher_name", "feed_version"),
}
"""Optional files and columns that are read if present."""


_ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    OSError,  # of bzip2, and of the disk
    RuntimeError,  # encrypted
    NotImplementedError,  # compressed by an unknown method
)
"""Exceptions of Python's zipfile for a zip file that it cannot read."""
_MAX_BYTES = 4 * 2**30
"""Maximum size of a feed's unpacked files, bytes."""


@dataclass(frozen=True)
class Feed:
    """Data frames of text by file, with blanks as missing values and all columns of REQUIRED and _OPTIONAL.

    A missing file is a frame without rows.
    """

    path: Path
    """Folder or zip file, as named by the caller."""
    frames: dict[str, pd.DataFrame]

    def __getitem__(self, file: str) -> pd.DataFrame:
        return self.frames[file]


def read_feed(path: Path) -> Feed:
    """Read a feed.

    Raises HeadwayError naming the file, and the column, that is missing or cannot be read.
    """
    if path.is_dir():
        inside = _locate_files(path, [file.relative_to(path).as_posix() for file in path.rglob("*.txt")])
        frames = {
            name: _read_frame(name, _content(path / inside[name]) if name in inside else None)
            for name in {**REQUIRED, **_OPTIONAL}
        }
    elif path.is_file() and zipfile.is_zipfile(path):
        frames = _read_zip(path)
    else:
        what = "is not a zip file" if path.is_file() else "does not exist"
        raise HeadwayError(f"{path} {what}; give a GTFS feed, as a zip or a folder of .txt files")
    for name in REQUIRED:
        if frames[name].empty:
            raise HeadwayError(f"{name}.txt has no rows; a timetable cannot be read without it")
    if frames["calendar"].empty and frames["calendar_dates"].empty:
        raise HeadwayError(
            f"{path}: neither calendar.txt nor calendar_dates.txt has rows; no day has service"
        )
    return Feed(path, frames)


def _content(path: Path) -> bytes:
    """Return a file's content. Raises HeadwayError for a pipe or a device, which never ends, and if it
    cannot be read."""
    if not path.is_file():
        raise HeadwayError(f"{path} is not a regular file; remove it")
    try:
        return path.read_bytes()
    except OSError as error:
        raise HeadwayError(f"{path} cannot be read ({error.strerror}); fetch it again") from error


def _read_zip(path: Path) -> dict[str, pd.DataFrame]:
    """Return the files of a zip. Raises HeadwayError if it is damaged, encrypted or unpacks to too much."""

    def unpacked(name: str) -> bytes | None:
        return archive.read(inside[name]) if name in inside else None

    try:
        with zipfile.ZipFile(path) as archive:
            inside = _locate_files(path, archive.namelist())
            size = sum(archive.getinfo(name).file_size for name in inside.values())
            if size > _MAX_BYTES:
                raise HeadwayError(
                    f"{path} unpacks to {size / 2**30:.0f} GiB, more than {_MAX_BYTES // 2**30}; "
                    "leave out what is not needed"
                )
            contents = {name: unpacked(name) for name in {**REQUIRED, **_OPTIONAL}}
    except _ZIP_ERRORS as error:
        raise HeadwayError(f"{path} is a damaged or encrypted zip ({error}); fetch it again") from error
    return {name: _read_frame(name, content) for name, content in contents.items()}


def seconds(file: str, column: str, texts: "pd.Series[str]") -> Floats:
    """Return texts HH:MM:SS, also past 24 h, as seconds after midnight; NaN for blanks.

    Raises HeadwayError that names the line of any other text.
    """
    codes, values = pd.factorize(texts)
    parsed = np.full(len(values) + 1, np.nan)  # the extra last element is for code -1, a blank
    for place, text in enumerate(values):
        parts = str(text).split(":")
        if len(parts) != 3 or not all(part.strip().isdigit() for part in parts):
            row = texts.index[int(np.flatnonzero(codes == place)[0])] + 2
            raise HeadwayError(f"{file}.txt, line {row}, {column}: '{text}' is not a time HH:MM:SS")
        hours, minutes, rest = (int(part) for part in parts)
        parsed[place] = 3600.0 * hours + 60.0 * minutes + rest
    return parsed[codes]


def numbers(file: str, column: str, texts: "pd.Series[str]") -> Floats:
    """Return texts as numbers; NaN for blanks. Raises HeadwayError naming the line of any other text."""
    values = pd.to_numeric(texts, errors="coerce").to_numpy(np.float64, na_value=np.nan)
    wrong = np.isnan(values) & texts.notna().to_numpy()
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise HeadwayError(
            f"{file}.txt, line {texts.index[row] + 2}, {column}: '{texts.iloc[row]}' is not a number"
        )
    return np.asarray(values, np.float64)


def _locate_files(feed: Path, files: Iterable[str]) -> dict[str, str]:
    """Return the path of each known file, in any folder of the feed.

    Raises HeadwayError if a required file is missing, and if a file occurs twice, because the identifiers of
    two feeds would clash.
    """
    found: dict[str, str] = {}
    for file in sorted(files):
        name = PurePosixPath(file).name.removesuffix(".txt")
        if f"{name}.txt" != PurePosixPath(file).name or name not in {**REQUIRED, **_OPTIONAL}:
            continue
        if name in found:
            raise HeadwayError(
                f"{feed} holds {found[name]} and {file}; keep a single feed there and in its folders"
            )
        found[name] = file
    for name in REQUIRED:
        if name not in found:
            raise HeadwayError(f"{feed} has no {name}.txt; a timetable cannot be read without it")
    return found


def _read_frame(name: str, content: bytes | None) -> pd.DataFrame:
    """Return the known columns of a file, with surrounding blanks removed.

    Raises HeadwayError for missing columns and unreadable files.
    """
    needed, wanted = REQUIRED.get(name, ()), (*REQUIRED.get(name, ()), *_OPTIONAL.get(name, ()))
    if content is None:
        return pd.DataFrame({column: pd.Series(dtype="str") for column in wanted})
    encoding = _encoding(content)
    header = content.split(b"\n", 1)[0].decode(encoding).lstrip("\ufeff")
    try:
        columns = [column.strip() for column in next(csv.reader([header]), [])]
    except csv.Error as error:
        raise HeadwayError(f"{name}.txt is not a table of comma-separated values ({error})") from error
    for column in needed:
        if column not in columns:
            raise HeadwayError(f"{name}.txt has no column {column}; a timetable cannot be read without it")
    here = [column for column in wanted if column in columns]
    try:
        table = arrow_csv.read_csv(
            io.BytesIO(content),
            read_options=arrow_csv.ReadOptions(column_names=columns, skip_rows=1, encoding=encoding),
            parse_options=arrow_csv.ParseOptions(newlines_in_values=name != "stop_times"),
            convert_options=arrow_csv.ConvertOptions(
                include_columns=here,
                column_types={column: pa.string() for column in here},
                strings_can_be_null=True,
                null_values=[""],
            ),
        )
    except (pa.ArrowInvalid, UnicodeDecodeError) as error:
        raise HeadwayError(f"{name}.txt is not a table of comma-separated values ({error})") from error
    frame = pd.DataFrame({column: _strip(table[column]) for column in here})
    return frame.assign(**{column: pd.Series(dtype="str") for column in wanted if column not in here})


def _strip(column: pa.ChunkedArray) -> pd.Series:
    """Return a column without surrounding blanks; only blank texts become missing values."""
    # A few distinct texts repeat often: strip each only once.
    encoded = column.combine_chunks().dictionary_encode()
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.chunk(0) if encoded.num_chunks else pa.array([], pa.string()).dictionary_encode()
    texts = pc.utf8_trim_whitespace(encoded.dictionary)
    values = np.array([text or None for text in texts.to_pylist()] + [None], dtype=object)
    codes = encoded.indices.fill_null(len(values) - 1).to_numpy(zero_copy_only=False)
    return pd.Series(values[codes], dtype="str")


def _encoding(content: bytes) -> str:
    """Return the encoding of a file: UTF-8, as the standard requires, or Latin-1, which some feeds use."""
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"
