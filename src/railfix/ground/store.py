"""Stored state of the centre: trains, authorities and the log, in SQLite (WAL) or another SQL database.

Reports are committed before they are acknowledged, and authorities before they are sent, so that a centre that is
killed at any moment can restore them.
"""

from __future__ import annotations

import fcntl
import uuid
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Final, Self

from railfix.core.errors import InputFileError, OutputError
from railfix.core.extras import needs_extra
from railfix.ground.centre import TrainRecord
from railfix.io.train_message import decode, encode

with needs_extra():
    import sqlalchemy as sql
    from sqlalchemy import event

_META: Final = sql.MetaData()
#: Largest number of log lines kept in memory while the database fails; if there are more, the oldest are dropped.
MOST_NOTES: Final = 10_000
#: Largest number of log lines in the database; older lines are deleted.
MOST_LINES: Final = 1_000_000
#: Name of the stored document that identifies the process in charge of the database.
_IN_CHARGE: Final = "centre in charge"
TRAINS: Final = sql.Table(
    "trains",
    _META,
    sql.Column("train", sql.BigInteger, primary_key=True, autoincrement=False),
    sql.Column("sequence", sql.BigInteger, nullable=False),
    sql.Column("session", sql.BigInteger, nullable=False),
    sql.Column("message", sql.LargeBinary),
)
DOCUMENTS: Final = sql.Table(
    "documents",
    _META,
    sql.Column("name", sql.String(64), primary_key=True),
    sql.Column("text", sql.Text, nullable=False),
)
LOG: Final = sql.Table(
    "log",
    _META,
    sql.Column("number", sql.Integer, primary_key=True, autoincrement=True),
    sql.Column("time_ns", sql.BigInteger, nullable=False),
    sql.Column("train", sql.BigInteger),
    sql.Column("text", sql.Text, nullable=False),
)


class DatabaseError(OutputError):
    """Error raised if the database does not accept data at present."""


class Store:
    """Stored state of a centre in a database (``sqlite:///centre.db``, ``postgresql+psycopg://...``).

    Raise InputFileError if the database cannot be opened.
    """

    def __init__(self, url: str, *, most_lines: int = MOST_LINES) -> None:
        try:
            self._engine = sql.create_engine(url, connect_args=_time_outs(url))
            if self._engine.dialect.name == "sqlite":
                event.listen(self._engine, "connect", _durable)
            _META.create_all(self._engine)
        except (sql.exc.SQLAlchemyError, ImportError) as error:
            raise InputFileError(url, f"cannot be opened as the centre's database ({error})") from None
        self._connection = self._engine.connect()
        self._url = url
        self._token: str | None = None
        self._lock: IO[str] | None = None
        self._notes: list[dict[str, Any]] = []
        self.abandoned = False  #: Whether a commit in a thread may still use the connection.
        self._most_lines, self._written = most_lines, 0

    def take_charge(self) -> None:
        """Make this process the only one that can commit; later commits of an earlier centre fail.

        Raise InputFileError if another process on this machine uses the SQLite database.
        """
        database = self._engine.url.database
        if self._engine.dialect.name == "sqlite" and database:
            self._lock = Path(f"{database}.lock").open("a")  # noqa: SIM115 (kept until the store is closed)
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                self._lock.close()
                self._lock = None
                raise InputFileError(database, "is in use by another centre; end that centre first") from None
        token = uuid.uuid4().hex
        with self._connection.begin():
            charge = DOCUMENTS.update().where(DOCUMENTS.c.name == _IN_CHARGE).values(text=token)
            if self._connection.execute(charge).rowcount == 0:
                self._connection.execute(DOCUMENTS.insert().values(name=_IN_CHARGE, text=token))
        self._token = token

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Commit the remaining lines of the log, if the database accepts them, and close the database."""
        if self.abandoned:
            return
        if self._notes and not self._connection.invalidated:
            with suppress(DatabaseError, InputFileError):
                self.save()
        if self._lock is not None:
            self._lock.close()
        self._connection.close()
        self._engine.dispose()

    def save(self, *records: TrainRecord, documents: Mapping[str, str | None] | None = None) -> None:
        """Commit train reports, named texts (None removes a text) and the lines of the log.

        Raise InputFileError if another centre has taken charge of the database since `take_charge`. Raise DatabaseError
        if the database fails; nothing is stored in this case, and the lines of the log are kept.
        """
        notes = self._notes[:]  # another thread may add lines during the commit
        try:
            self._save(records, documents or {}, notes)
        except sql.exc.SQLAlchemyError as error:
            reason = getattr(error, "orig", None) or error
            del self._notes[:-MOST_NOTES]
            raise DatabaseError(f"the database cannot be written ({' '.join(str(reason).split())})") from None
        del self._notes[: len(notes)]

    def _save(
        self, records: Iterable[TrainRecord], documents: Mapping[str, str | None], notes: list[dict[str, Any]]
    ) -> None:
        trains = [
            {"train": record.train, "sequence": record.sequence, "session": record.session,
             "message": None if record.message is None else encode(record.message)}
            for record in records
        ]  # fmt: skip
        with self._connection.begin():
            if self._token is not None:
                # the row is written, not only read, so that it stays locked until the commit
                mine = (DOCUMENTS.c.name == _IN_CHARGE) & (DOCUMENTS.c.text == self._token)
                if self._connection.execute(DOCUMENTS.update().where(mine).values(text=self._token)).rowcount != 1:
                    raise InputFileError(
                        self._url, "another centre has taken charge of this database; this centre ends"
                    )
            self._put(TRAINS.c.train, trains)
            self._put(
                DOCUMENTS.c.name, [{"name": n, "text": text} for n, text in documents.items() if text is not None]
            )
            for name in [name for name, text in documents.items() if text is None]:
                self._connection.execute(DOCUMENTS.delete().where(DOCUMENTS.c.name == name))
            if notes:
                self._connection.execute(LOG.insert(), notes)
                self._forget_old_lines(len(notes))

    def _forget_old_lines(self, added: int) -> None:
        """Delete the oldest lines of the log beyond the limit, each time a hundredth of the limit has been added."""
        self._written += added
        if self._written <= self._most_lines // 100:
            return
        self._written = 0
        newest = self._connection.execute(sql.select(sql.func.max(LOG.c.number))).scalar() or 0
        self._connection.execute(LOG.delete().where(LOG.c.number <= newest - self._most_lines))

    def note(self, time_ns: int, text: str, *, train: int | None = None) -> None:
        """Add a line to the log; it is committed by the next `save` or by `close`."""
        self._notes.append({"time_ns": time_ns, "train": train, "text": text})

    def records(self) -> dict[int, TrainRecord]:
        """Return the stored records of all trains, with their last positions and the state `TrainState.UNKNOWN`."""
        with self._connection.begin():
            rows = self._connection.execute(sql.select(TRAINS).order_by(TRAINS.c.train)).all()
        return {
            row.train: TrainRecord(
                train=row.train,
                sequence=row.sequence,
                session=row.session,
                message=(message := None if row.message is None else decode(bytes(row.message))),
                shown_m=None if message is None or message.chainage_cm is None else message.chainage_cm / 100.0,
            )
            for row in rows
        }

    def document(self, name: str) -> str | None:
        """Return a named text, None if it does not exist."""
        with self._connection.begin():
            return self._connection.execute(sql.select(DOCUMENTS.c.text).where(DOCUMENTS.c.name == name)).scalar()

    def documents(self, beginning: str) -> dict[str, str]:
        """Return the texts whose names start with `beginning`."""
        named = sql.select(DOCUMENTS.c.name, DOCUMENTS.c.text).where(
            DOCUMENTS.c.name.startswith(beginning, autoescape=True)
        )
        with self._connection.begin():
            return {row.name: row.text for row in self._connection.execute(named)}

    def log(self, *, last: int = 100) -> list[tuple[int, int | None, str]]:
        """Return the newest committed lines of the log, oldest first: time [ns], train, text."""
        query = sql.select(LOG).order_by(LOG.c.number.desc()).limit(last)
        with self._connection.begin():
            rows = self._connection.execute(query).all()
        return [(row.time_ns, row.train, row.text) for row in reversed(rows)]

    def _put(self, key: sql.Column[Any], rows: list[dict[str, Any]]) -> None:
        """Replace the rows with the same keys; if `rows` has several rows with one key, the last is used."""
        if rows := list({row[key.name]: row for row in rows}.values()):
            self._connection.execute(
                key.table.delete().where(key == sql.bindparam("of")), [{"of": row[key.name]} for row in rows]
            )
            self._connection.execute(key.table.insert(), rows)


def _time_outs(url: str) -> dict[str, Any]:
    """Return a connection's time-outs for connecting, for statements, and for network interruptions."""
    if url.startswith("postgresql"):
        return {"connect_timeout": 2, "tcp_user_timeout": 5000, "options": "-c statement_timeout=5000"}
    if url.startswith(("mysql", "mariadb")):
        return {"connect_timeout": 2, "read_timeout": 5, "write_timeout": 5}
    return {}


def _durable(connection: Any, _record: object) -> None:
    """Set an SQLite connection to write-ahead logging; a commit returns only when its data are on disk."""
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "busy_timeout=1000"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()
