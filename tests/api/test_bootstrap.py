"""The one command that sets up and runs, where there is something to decide."""

import bootstrap


def test_no_python_for_the_newest_jax_is_said_loudly(monkeypatch, capsys):
    """Where no Python can run the newest jax, the command says that nothing was run, and does not fail."""
    monkeypatch.setattr(bootstrap, "find_python", lambda oldest: None)
    assert bootstrap.main(["newest"]) == 0
    assert "NOT RUN: the newest jax needs Python 3.12" in capsys.readouterr().out


def test_a_python_is_found_that_is_new_enough():
    """The Python that runs this is found for the oldest; none is found for one that does not exist."""
    assert bootstrap.find_python((3, 11)) is not None
    assert bootstrap.find_python((4, 0)) is None
