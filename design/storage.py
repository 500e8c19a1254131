"""Where a study is kept: an SQLite file, or a database server that machines share."""

from __future__ import annotations

import contextlib
import inspect
import os
import random
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import optuna
from sqlalchemy import event
from sqlalchemy.engine import URL, Connection, make_url
from sqlalchemy.exc import ArgumentError, IntegrityError, OperationalError, ProgrammingError
from sqlalchemy.exc import SQLAlchemyError as DatabaseError

from gns_model.errors import GnsError
from gns_model.interrupts import postponed

#: Signs of life that a worker gives within the time after which it counts as dead.
BEATS = 4
#: How long to wait for a server to answer, and for another process to let go of a file [s].
CONNECT, LOCKED = 10, 60
#: How often workers that make the tables of a new study at the same time get out of their way.
TABLE_TRIES = 6


class StudyError(GnsError):
    """A study that cannot be opened, or that belongs to another task."""


class Storage(optuna.storages.RDBStorage):
    """An RDBStorage of which an interrupt cuts no transaction in two.

    One that is raised between BEGIN and the line that would roll back leaves a transaction that
    nobody ends: everybody, its own process too, then waits for its lock.
    """


for _name, _method in vars(optuna.storages.RDBStorage).items():
    if inspect.isfunction(_method) and not _name.startswith("__"):
        setattr(Storage, _name, postponed()(_method))


def open_storage(storage: str, grace: int | None) -> Storage:
    """The storage at an address, its tables made.

    Args:
        storage: SQLAlchemy's address; `postgresql://` stands for the driver psycopg.
        grace: seconds without a sign of life after which a trial's worker counts as dead; None: it
            has no other worker.

    Raises:
        SQLAlchemyError, ImportError, StorageInternalError: see `storage_errors`.
    """
    url = make_url(storage)
    if url.drivername in ("postgresql", "postgres"):
        url = url.set(drivername="postgresql+psycopg")
    kind = url.get_backend_name()
    arguments = {"sqlite": {"timeout": LOCKED}, "postgresql": {"connect_timeout": CONNECT}}
    options: dict[str, Any] = {"connect_args": arguments.get(kind, {})}
    if kind != "sqlite":
        options["pool_pre_ping"] = True
    address = url.render_as_string(hide_password=False)
    for k in range(TABLE_TRIES):
        try:
            with warnings.catch_warnings(), postponed():
                warnings.simplefilter("ignore")  # heartbeats are "experimental" since 2021
                backend = Storage(
                    address,
                    engine_kwargs=options,
                    heartbeat_interval=grace and max(grace // BEATS, 1),
                    grace_period=grace,
                )
            break
        except (IntegrityError, ProgrammingError, OperationalError) as error:
            # Two workers that make the tables at once: the second finds them there next time.
            made = any(word in str(error).lower() for word in ("exists", "duplicate", "unique"))
            if not made or k == TABLE_TRIES - 1:
                raise
            time.sleep(random.uniform(0.1, 0.5))
    if kind == "sqlite":
        event.listen(backend.engine, "connect", _tune)
        event.listen(backend.engine, "begin", _take_the_lock)
        backend.engine.dispose()  # connect anew
    return backend


def _tune(connection: Any, _: Any) -> None:
    # A trial is about ten commits, each a wait for the disk (30 ms on a busy one) unless the
    # log is written ahead; a power cut may then cost the last trials and never the file.
    with contextlib.suppress(Exception):  # a file system that cannot do it does without
        connection.execute("PRAGMA journal_mode=WAL").fetchone()
        connection.execute("PRAGMA synchronous=NORMAL")
    connection.isolation_level = None  # `_take_the_lock` begins, not the driver


def _take_the_lock(connection: Connection) -> None:
    # SQLite knows no row locks: without this two workers can read the same waiting trial and both
    # take it, or give two trials one number.
    connection.exec_driver_sql("BEGIN IMMEDIATE")


@contextlib.contextmanager
def storage_errors(storage: str) -> Iterator[None]:
    """Turn what a database can throw (unreachable, full disk, foreign file) into a StudyError."""
    try:
        yield
    except (DatabaseError, optuna.exceptions.StorageInternalError, ImportError) as error:
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        text = str(cause) or type(cause).__name__
        if isinstance(cause, ModuleNotFoundError) and (cause.name or "").startswith("psycopg"):
            text = "the driver psycopg is missing: pip install 'gns-baffles[postgres]'"
        raise StudyError(f"study storage {public(storage)}: {_scrub(text, storage)}") from error
    except (RuntimeError, ValueError) as error:
        if isinstance(error, GnsError) or "optuna" not in str(error).lower():
            raise
        text = _scrub(str(error), storage)
        raise StudyError(f"study storage {public(storage)}: {text}") from error


def public(storage: str) -> str:
    """The address of a storage without user and password."""
    url = _url(storage)
    if url is None:
        return storage.rsplit("@", 1)[-1]
    bare = URL.create(url.drivername, host=url.host, port=url.port, database=url.database)
    return bare.render_as_string()


def _scrub(text: str, storage: str) -> str:
    """`text` without the password, should a driver quote it."""
    url = _url(storage)
    secrets = [] if url is None else [url.password, *url.query.values()]
    for secret in secrets:
        for word in [secret] if isinstance(secret, str) else secret or ():
            text = text.replace(word, "***") if len(word) > 3 else text
    return text


def _url(storage: str) -> URL | None:
    try:
        return make_url(storage)
    except (ArgumentError, ValueError):
        return None


def sqlite_url(path: str | os.PathLike[str]) -> str:
    """The storage address of an SQLite file."""
    return f"sqlite:///{Path(path).resolve()}"
