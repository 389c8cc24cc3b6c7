"""Where trials are kept: rows in a SQLite file, and a folder for the files of each trial."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
import hashlib
import json
import os
from pathlib import Path
import shutil
import sqlite3
from typing import Any

from sgvf_drake.exceptions import ConfigurationError, ExperimentError
from sgvf_drake.experiments.results import plain

ROWS = "rows.sqlite"
# How long a process waits for others that write, s.
PATIENCE_S = 60.0
# Digits of the digest in the name of a trial's folder.
KEY_DIGITS = 16

_TABLE = """CREATE TABLE IF NOT EXISTS trials (
    measure TEXT, trial TEXT, code TEXT, row TEXT, elapsed_s REAL,
    PRIMARY KEY (measure, trial, code))"""
_FIND = """SELECT code, row, elapsed_s FROM trials WHERE measure = ? AND trial = ?
    ORDER BY code = ? DESC, rowid DESC"""
_PUT = "INSERT OR REPLACE INTO trials VALUES (?, ?, ?, ?, ?)"

Row = dict[str, Any]


@dataclass(frozen=True)
class Key:
    """What a stored trial is known by.

    Attributes:
        measure: The function that measures it, by its module and name.
        trial: Its values, as JSON.
        code: The digest of the code under both.
    """

    measure: str
    trial: str
    code: str

    @property
    def folder(self) -> str:
        """The name of the folder with the files of the trial."""
        text = json.dumps([self.measure, self.trial, self.code])
        digest = hashlib.sha256(text.encode()).hexdigest()[:KEY_DIGITS]
        return f"{self.measure.rpartition('.')[2]}-{digest}"


@dataclass(frozen=True, eq=False)
class Record:
    """A trial that has run.

    Attributes:
        row: What it measured, as plain JSON values.
        folder: The files that it left.
        elapsed_s: How long it took, when it ran.
        code: The digest of the code that measured it.
    """

    row: Row
    folder: Path
    elapsed_s: float
    code: str


class TrialStore:
    """Keeps what trials found; several processes may write at once, and any may be killed.

    Args:
        folder: Where; made when the first trial is stored.
        any_code: Whether a trial that other code has measured counts, where there is none of
            the same code.
    """

    def __init__(self, folder: Path, any_code: bool = False) -> None:
        self.folder = folder
        self.any_code = any_code

    def make_folder(self) -> None:
        """Makes the folder, if it is not there.

        Raises:
            ConfigurationError: If it cannot be made.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"cannot write to {self.folder}: {error.strerror}"
            ) from None

    def find(self, key: Key) -> Record | None:
        """Returns a trial that is stored with its files, else None.

        Raises:
            ExperimentError: If the file of rows is damaged, or stays locked.
        """
        if not (self.folder / ROWS).exists():
            return None
        with self._database() as database:
            rows = database.execute(_FIND, (key.measure, key.trial, key.code)).fetchall()
        for code, row, elapsed_s in rows:
            folder = self.folder / Key(key.measure, key.trial, code).folder
            if (code == key.code or self.any_code) and folder.is_dir():
                return Record(json.loads(row), folder, elapsed_s, code)
        return None

    def put(self, key: Key, row: Row, files: Path, elapsed_s: float) -> None:
        """Stores a trial, whole or not at all; if it is there already, that one stays.

        Args:
            key: What it is known by.
            row: What it measured.
            files: The folder of its files, which is moved; on the same file system.
            elapsed_s: How long it took.

        Raises:
            TypeError: If the row cannot be JSON.
            ExperimentError: If the file of rows is damaged, or stays locked.
        """
        text = json.dumps(plain(row), allow_nan=False)
        target = self.folder / key.folder
        with self._database() as database:
            known = database.execute(_FIND, (key.measure, key.trial, key.code)).fetchone()
            if known is None or known[0] != key.code or not target.is_dir():
                # Of a process that was killed between its files and its row.
                shutil.rmtree(target, ignore_errors=True)
                os.replace(files, target)
                values = (key.measure, key.trial, key.code, text, elapsed_s)
                database.execute(_PUT, values)

    @contextmanager
    def _database(self) -> Iterator[sqlite3.Connection]:
        """Gives the file of rows to this process alone, until it is done or fails."""
        file = self.folder / ROWS
        try:
            with closing(
                sqlite3.connect(file, timeout=PATIENCE_S, isolation_level=None)
            ) as database:
                # At once: who asks for it only when it writes may be refused without waiting.
                database.execute("BEGIN IMMEDIATE")
                database.execute(_TABLE)
                yield database
                database.execute("COMMIT")
        except sqlite3.Error as error:
            raise ExperimentError(f"cannot use the stored trials in {file}: {error}") from None


def make_key(measure: Any, trial: Any, code: str) -> Key:
    """Returns the key of a trial, which is a dataclass of plain values."""
    values = json.dumps(plain(asdict(trial)), sort_keys=True)
    return Key(f"{measure.__module__}.{measure.__qualname__}", values, code)
