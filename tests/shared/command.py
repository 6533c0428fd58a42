"""A command of vggtjax in this process."""

from typing import Any

from vggtjax.interface.commands import main as cli


def run(capsys: Any, *words: object) -> tuple[int, str, str]:
    """Return the exit code, the output and what was said beside it."""
    code = cli.main([str(word) for word in words])
    shown = capsys.readouterr()
    return code, shown.out, shown.err


def refusal(capsys: Any, *words: object) -> str:
    """Return the sentence that a command ends with which is refused."""
    code, _, said = run(capsys, *words)
    sentence = said.strip().splitlines()[-1]
    assert (code, sentence.startswith("vggtjax: "), "Traceback" in said) == (2, True, False), said
    return sentence
