"""A PostgreSQL server of the system's packages, in a folder that is thrown away."""

import glob
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

PASSWORD = "open-sesame"


def programs():
    """The folder of initdb and postgres, None if there is none or no driver to talk to it."""
    try:
        import psycopg  # noqa: F401
    except ImportError:
        return None
    found = [shutil.which("initdb"), *sorted(glob.glob("/usr/lib/postgresql/*/bin/initdb"))]
    folders = [Path(p).resolve().parent for p in found if p]
    return next((f for f in folders[::-1] if (f / "postgres").exists()), None)


def _unprivileged():
    """Options for subprocess: the server refuses to run as root."""
    if os.geteuid() != 0:
        return {}
    names = {entry.pw_name: entry for entry in pwd.getpwall()}
    entry = names.get("postgres") or names["nobody"]
    return {"user": entry.pw_uid, "group": entry.pw_gid, "extra_groups": []}


@contextmanager
def server():
    """The port of a server that runs until the end; user gns, see `PASSWORD`."""
    folder = Path(tempfile.mkdtemp(prefix="gns-postgres-"))
    run_as, bin_ = _unprivileged(), programs()
    (folder / "password").write_text(PASSWORD)
    if run_as:
        for path in (folder, folder / "password"):
            os.chown(path, run_as["user"], run_as["group"])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = None
    try:
        subprocess.run(
            [bin_ / "initdb", "-D", folder / "data", "-U", "gns", "-A", "scram-sha-256",
             "--pwfile", folder / "password", "--no-sync", "-E", "UTF8", "--locale", "C"],
            check=True, capture_output=True, cwd=folder, **run_as,
        )  # fmt: skip
        options = {
            "listen_addresses": "127.0.0.1", "port": port, "fsync": "off",
            "unix_socket_directories": folder, "shared_buffers": "16MB", "max_connections": 40,
        }  # fmt: skip
        with (folder / "log").open("wb") as log:
            process = subprocess.Popen(
                [bin_ / "postgres", "-D", folder / "data"]
                + [word for key, value in options.items() for word in ("-c", f"{key}={value}")],
                stdout=log, stderr=log, cwd=folder, **run_as,
            )  # fmt: skip
        _until_it_answers(port, folder)
        yield port
    finally:
        if process is not None:
            process.send_signal(signal.SIGINT)  # "fast": it lets go of its clients
            process.wait(30)
        shutil.rmtree(folder, ignore_errors=True)


def _until_it_answers(port, folder):
    import psycopg

    for _ in range(150):
        try:
            with psycopg.connect(
                host="127.0.0.1", port=port, user="gns", password=PASSWORD, dbname="postgres"
            ):
                return
        except psycopg.OperationalError:
            time.sleep(0.1)
    raise RuntimeError((folder / "log").read_text())
