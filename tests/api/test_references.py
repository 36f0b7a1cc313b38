"""Whatever pages and docstrings name exists: files, headings, commands with their options, functions, classes, members and keywords.

Looked at are words between backticks that are a path, a name, a call or a keyword; formulas and symbols of one letter are not. A name may
be the library's, that of the code the docstring is about, Python's or of a package in `references.FOREIGN`.
"""

import pytest

from tests import markdown, references, source

# What exists, but not here.
ELSEWHERE = {
    "jaxspring-elevation/": "the folder that the command writes",
    "benchmarks/results/": "the folder that benchmarks write",
    "JAX_COMPILATION_CACHE_DIR": "a variable that JAX reads",
    "XLA_FLAGS=--xla_cpu_max_isa=AVX2": "a variable that XLA reads",
    "heartbeat_timeout_seconds": "an argument of jax.distributed.initialize",
    "fn": "a field of diffrax.SaveAt",
    "root_finder": "a field of diffrax.Event",
    "run.pvd": "a file that save_vtk names after the user's folder",
    "run_0000.vtu": "a file that save_vtk names after the user's folder",
    "run_0000.ply": "a file that save_ply names after the user's folder",
    "pbc": "a word of the XYZ format",
    "v_x": "a column of such a file",
    "v_y": "a column of such a file",
    "v_z": "a column of such a file",
}
PAGES = [*source.ROOT.glob("*.md"), *(source.ROOT / "docs").glob("*.md")]


@pytest.mark.slow
def test_names_in_backticks_exist():
    """Paths, names, calls and keywords on pages (the changelog apart, which tells of old ones) and in all docstrings."""
    spans = [(text, span) for text in references.texts() for span in references.spans(text.text)]
    assert len(spans) > 2000
    wrong = [(text.place, span, why) for text, span in spans if span not in ELSEWHERE and (why := references.complaint(span, text))]
    assert wrong == []
    assert set(ELSEWHERE) - {span for _, span in spans} == set()


def test_commands_exist():
    """Commands on pages and in docstrings call a module that is there, with a subcommand and options that it knows."""
    lines = [(text.place, line) for text in references.texts() for line in references.commands(text.text)]
    assert len(lines) > 40
    assert [(place, line, why) for place, line in lines if (why := references.command_complaint(line))] == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_links_lead_somewhere(path):
    """Every relative link or picture on a page names a file that exists, and a heading in it where it names one."""
    links = markdown.links(path)
    assert [target for target, _ in links if not target.exists()] == []
    headed = [(target, heading) for target, heading in links if heading and target.suffix == ".md"]
    assert [(target, heading) for target, heading in headed if heading not in markdown.headings(target)] == []
