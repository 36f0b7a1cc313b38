"""An environment of its own for each peer, in .cache/peers/, from the versions in `benchmarks/requirements-peers/`.

Not below `benchmarks/`: tests and checkers read every Python file there.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import venv
from pathlib import Path

FOLDER = Path(__file__).parents[2] / ".cache" / "peers"
REQUIREMENTS = Path(__file__).parents[1] / "requirements-peers"
# Who runs in this environment, and what their version is read from.
AT_HOME = {"jaxspring": "jax", "scipy": "scipy", "c": None}
PACKAGES = {"warp": "warp-lang", **{name: name for name in ("newton", "numba", "taichi", "jax-md", "torch")}}


def python_of(contender: str) -> Path | None:
    """The Python that runs a contender; None where its environment is not there."""
    if contender in AT_HOME:
        return Path(sys.executable) if contender != "c" or shutil.which("cc") else None
    python = FOLDER / contender / "bin" / "python"
    return python if python.exists() else None


def set_up() -> None:
    """Make the environments that are not there yet, or whose list has changed; a peer that does not install is left out."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / ".gitignore").write_text("*\n")
    for peer in PACKAGES:
        wanted, made = REQUIREMENTS / f"{peer}.txt", FOLDER / peer / "requirements.txt"
        if made.exists() and made.read_text() == wanted.read_text():
            print(f"{peer}: is there", flush=True)
            continue
        print(f"{peer}: {_installed(FOLDER / peer, wanted)}", flush=True)
        if python_of(peer) is not None:
            shutil.copy(wanted, made)


def _installed(folder: Path, wanted: Path) -> str:
    """Make one environment; says how it went. One that failed is removed."""
    venv.create(folder, clear=True, with_pip=True)
    command = [folder / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-r", wanted]
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
    if done.returncode:
        shutil.rmtree(folder)
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        return f"left out, it does not install: {errors[-1] if errors else 'pip failed'}"
    return "installed"
