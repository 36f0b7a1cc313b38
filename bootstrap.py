"""Set up and run, from a fresh clone, with nothing but Python >= 3.11 (pip and venv with it).

    python3 bootstrap.py fit [...]     the main job; arguments go to `jaxspring fit`
    python3 bootstrap.py test [...]    the whole test suite; arguments go to pytest
    python3 bootstrap.py newest [...]  the same suite on the newest jax that the project allows, where this machine has a Python for it
    python3 bootstrap.py check         lint, format and types
    python3 bootstrap.py setup         only the set-up

The set-up is a virtual environment in .venv with the packages of requirements.lock, each checked by its hash; for `newest` it is
.venv-newest with those of requirements-newest.lock. Each is made once; an interrupted one is taken up where it stopped, because the
note that it is done is written last.
"""

import glob
import hashlib
import os
import pathlib
import shutil
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent
OLDEST = (3, 11)
OLDEST_FOR_NEWEST = (3, 12)  # what the newest jax asks for


class Environment:
    """A virtual environment of this clone, and the lock whose packages it holds."""

    def __init__(self, folder, lock, oldest):
        self.folder, self.lock, self.oldest = ROOT / folder, ROOT / lock, oldest
        self.python = self.folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
        self.done = self.folder / "jaxspring-set-up.sha256"

    def set_up(self, base):
        """Make the environment with the Python `base` unless it stands already; 0 when it does."""
        # The entry point and the place of the clone are part of what is installed, so they are part of the digest.
        parts = [self.lock.read_bytes(), (ROOT / "pyproject.toml").read_bytes()]
        digest = hashlib.sha256(b"\0".join([*parts, str(ROOT).encode()])).hexdigest()
        if self.done.is_file() and self.done.read_text() == digest and self.python.exists():
            return 0
        print("Setting up %s (once; some minutes)" % self.folder.name, flush=True)
        # An environment without pip, or of a Python that is too old, is half made or a stranger: start over.
        probe = "import sys, pip; sys.exit(sys.version_info < %r)" % (self.oldest,)
        usable = self.python.exists() and subprocess.call([str(self.python), "-c", probe], stderr=subprocess.DEVNULL) == 0
        install = [self.python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        failed = (
            (not usable and run([base, "-m", "venv", "--clear", self.folder]))
            or run([*install, "--require-hashes", "-r", self.lock])
            or run([*install, "--no-deps", "--no-build-isolation", "--editable", ROOT])
        )
        if failed:
            return fail("The set-up failed (see above). The same command takes it up again.")
        self.done.write_text(digest)
        return 0


LOCKED = Environment(".venv", "requirements.lock", OLDEST)
NEWEST = Environment(".venv-newest", "requirements-newest.lock", OLDEST_FOR_NEWEST)


def main(arguments):
    """Run one verb; the exit code is that of the first command that failed."""
    verbs = {"fit": fit, "test": test, "newest": newest, "check": check, "setup": lambda rest: 0}
    if sys.version_info < OLDEST:
        return fail("jaxspring needs Python %d.%d or newer; this is Python %d.%d." % (OLDEST + sys.version_info[:2]))
    if not arguments or arguments[0] not in verbs:
        return fail("usage: python3 bootstrap.py {%s} [arguments]" % ",".join(verbs))
    if arguments[0] == "newest":
        return newest(arguments[1:])
    return LOCKED.set_up(sys.executable) or verbs[arguments[0]](arguments[1:])


def fit(rest):
    """Run the main job where the caller stands."""
    return run([LOCKED.python, "-m", "jaxspring", "fit", *rest])


def test(rest):
    """Run every test: unit tests, slow ones, docstring examples, notebooks; on as many processes as there are cores, at most 4."""
    # Most of the suite's time is compiling, which XLA's older code for fused loops halves; `newest` and pytest alone use what users do.
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")
    return run_tests(LOCKED, rest)


def newest(rest):
    """Run every test on the newest jax, the last one first; without a Python that can run it, say so and go on."""
    base = find_python(OLDEST_FOR_NEWEST)
    if base is None:
        line = "=" * 100
        print("%s\nNOT RUN: the newest jax needs Python %d.%d or newer, and this machine has none." % (line, *OLDEST_FOR_NEWEST))
        print("Only the locked jax was tested. Install a newer Python and run: python3 bootstrap.py newest\n%s" % line, flush=True)
        return 0
    return NEWEST.set_up(base) or run_tests(NEWEST, ["--reversed", *rest])


def run_tests(environment, rest):
    """The test suite in this environment."""
    return run([environment.python, "-m", "pytest", "-n", "auto", "--maxprocesses", "4", "--dist", "worksteal", *rest], cwd=ROOT)


def find_python(oldest):
    """A Python of this machine that is new enough and can make environments; None where there is none."""
    names = ["python3.%d" % minor for minor in range(20, oldest[1] - 1, -1)]
    found = [sys.executable, *(path for path in map(shutil.which, names) if path)]
    # pyenv's own pythons are not on the path unless chosen: newest first.
    pyenv = os.environ.get("PYENV_ROOT", os.path.expanduser("~/.pyenv"))
    found += sorted(glob.glob(os.path.join(pyenv, "versions", "3.*", "bin", "python3")), key=version_in, reverse=True)
    probe = "import sys, venv, ensurepip; sys.exit(sys.version_info < %r or sys.version_info.releaselevel != 'final')" % (oldest,)
    return next((path for path in found if subprocess.call([path, "-c", probe], stderr=subprocess.DEVNULL) == 0), None)


def version_in(path):
    """The numbers of the version that is part of the path, for sorting."""
    return [int(part) for part in pathlib.Path(path).parts[-3].split(".") if part.isdigit()]


def check(rest):
    """Run the linter, the formatter in its checking mode, and the type checker."""
    commands = [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["basedpyright"]]
    return max([run([LOCKED.python, "-m", *command], cwd=ROOT) for command in commands])


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
