"""Set up and run, from a fresh clone, with nothing but Python >= 3.11 (pip and venv with it).

    python3 bootstrap.py fit [...]     the main job; arguments go to `jaxspring fit`
    python3 bootstrap.py test [...]    the whole test suite; arguments go to pytest
    python3 bootstrap.py check         lint, format and types
    python3 bootstrap.py setup         only the set-up

The set-up is a virtual environment in .venv with the packages of requirements.lock, each checked by its hash. It is done
once; an interrupted one is taken up where it stopped, because the note that it is done is written last.
"""

import hashlib
import os
import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent
VENV = ROOT / ".venv"
PYTHON = VENV / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
DONE = VENV / "jaxspring-set-up.sha256"
OLDEST = (3, 11)


def main(arguments):
    """Run one verb; the exit code is that of the first command that failed."""
    verbs = {"fit": fit, "test": test, "check": check, "setup": lambda rest: 0}
    if sys.version_info < OLDEST:
        return fail("jaxspring needs Python %d.%d or newer; this is Python %d.%d." % (OLDEST + sys.version_info[:2]))
    if not arguments or arguments[0] not in verbs:
        return fail("usage: python3 bootstrap.py {%s} [arguments]" % ",".join(verbs))
    return set_up() or verbs[arguments[0]](arguments[1:])


def fit(rest):
    """Run the main job where the caller stands."""
    return run([PYTHON, "-m", "jaxspring", "fit", *rest])


def test(rest):
    """Run every test: unit tests, slow ones, docstring examples, notebooks; on as many processes as there are cores, at most 4."""
    return run([PYTHON, "-m", "pytest", "-n", "auto", "--maxprocesses", "4", "--dist", "worksteal", *rest], cwd=ROOT)


def check(rest):
    """Run the linter, the formatter in its checking mode, and the type checker."""
    commands = [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["basedpyright"]]
    return max([run([PYTHON, "-m", *command], cwd=ROOT) for command in commands])


def set_up():
    """Make the environment unless it stands already; 0 when it does."""
    # The entry point and the place of the clone are part of what is installed, so they are part of the digest.
    parts = [(ROOT / name).read_bytes() for name in ("requirements.lock", "pyproject.toml")]
    digest = hashlib.sha256(b"\0".join([*parts, str(ROOT).encode()])).hexdigest()
    if DONE.is_file() and DONE.read_text() == digest and PYTHON.exists():
        return 0
    print("Setting up .venv (once; some minutes)", flush=True)
    # An environment without pip, or of a Python that is too old, is half made or a stranger: start over.
    probe = "import sys, pip; sys.exit(sys.version_info < %r)" % (OLDEST,)
    usable = PYTHON.exists() and subprocess.call([str(PYTHON), "-c", probe], stderr=subprocess.DEVNULL) == 0
    install = [PYTHON, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    failed = (
        (not usable and run([sys.executable, "-m", "venv", "--clear", VENV]))
        or run([*install, "--require-hashes", "-r", ROOT / "requirements.lock"])
        or run([*install, "--no-deps", "--no-build-isolation", "--editable", ROOT])
    )
    if failed:
        return fail("The set-up failed (see above). The same command takes it up again.")
    DONE.write_text(digest)
    return 0


def run(command, cwd=None):
    """Run a command to its end; returns its exit code."""
    return subprocess.call([str(part) for part in command], cwd=cwd)


def fail(message):
    """Say one line on the error stream; returns the exit code 2."""
    print(message, file=sys.stderr)
    return 2


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
