"""What a path does not keep of samples with times is said where the path is read."""

import numpy as np
import pytest

from cfplan.cli import run_command


def test_the_path_step_says_what_is_lost(tmp_path, monkeypatch, capsys):
    share = np.linspace(0.0, 1.0, 300)
    rows = np.column_stack([5.0 * share, 2.0 * share - 1.0, 0.5 * np.sin(3.0 * share), 1.0 + 0.0 * share])
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",")
    (tmp_path / "path.yaml").write_text("samples: log.csv\n")
    (tmp_path / "safety.yaml").write_text(
        "vehicle: crazyflie-2.1+\nspace: {low: [-2, -2, 0], high: [2, 2, 2], margin: 0.2}\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["cfplan", "plan", "path.yaml"])
    with pytest.raises(SystemExit) as ending:
        run_command()
    assert not ending.value.code
    told = capsys.readouterr().out
    assert "timing is not kept: 5.0 s of 300 samples" in told
    assert "mm from the path" in told
