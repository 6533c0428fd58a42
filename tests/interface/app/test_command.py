"""The command: other machines are let in with a password only; old flags and used ports are one sentence."""

from importlib.util import find_spec

import pytest

from vggtjax.errors import InputError
from vggtjax.interface.commands.main import main
from vggtjax.results.viewer.access import listening

pytestmark = pytest.mark.skipif(find_spec("gradio") is None, reason="the app needs the extra app")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--host 0.0.0.0", "--host is '0.0.0.0', which other machines reach: give a --password"),
        ("--host ::", "--host is '::', which other machines reach: give a --password"),
        ("--host 192.168.0.7", "which other machines reach: give a --password"),
        ("--host example.org", "which other machines reach: give a --password"),
        ("--host 0.0.0.0 --password short", "--password is 5 characters long; expected at least 8"),
        ("--host 127.0.0.1 --password=", "--password is 0 characters long; expected at least 8"),
        ("--token 0123456789abcdef", "app --token is no longer there: --password"),
        ("--max-results=3", "app --max-results is no longer there: results are removed after a day"),
        ("--max_results 3", "app --max-results is no longer there: results are removed after a day"),
        ("--max-waiting 0", "--max-waiting is 0"),
        ("--port 70000", "--port is 70000; expected 0 to 65535"),
    ],
)
def test_a_refusal_is_one_sentence(capsys, arguments, said):
    assert main(["app", *arguments.split()]) == 2
    printed = capsys.readouterr().err
    assert said in printed
    assert printed.count("\n") == 1


def test_a_port_in_use_is_one_sentence(capsys):
    with listening("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        assert main(["app", "--port", str(port)]) == 2
    assert f"port {port} of 127.0.0.1 is in use; give another one with --port" in capsys.readouterr().err
    with pytest.raises(InputError, match="port is 70000; expected 0 to 65535"), listening("127.0.0.1", 70000):
        pass


def test_a_missing_extra_is_named(capsys, monkeypatch):
    monkeypatch.setattr("vggtjax.errors.find_spec", lambda name: None)
    assert main(["app"]) == 2
    assert "pip install -e '.[app]'" in capsys.readouterr().err
