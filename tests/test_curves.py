"""Curves survive a resume without a step standing twice."""

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from learner.curves import CurvesError, CurvesWriter, plot_curves, read_curves


def open_writer(folder, resume_from=None, columns=("loss", "return")):
    return CurvesWriter(
        csv_path=folder / "curves.csv",
        tensorboard=folder / "tensorboard",
        columns=columns,
        resume_from=resume_from,
    )


def scalars(folder, name):
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return [(event.step, event.value) for event in events.Scalars(name)]


def test_rows_go_to_both(tmp_path):
    writer = open_writer(tmp_path)
    writer.write(10, {"loss": 0.5})
    writer.write(20, {"loss": 0.25, "return": -1.0})
    writer.close()
    text = (tmp_path / "curves.csv").read_text()
    assert text == "updates,loss,return\n10,0.5,\n20,0.25,-1\n"
    assert scalars(tmp_path, "loss") == [(10, 0.5), (20, 0.25)]
    assert scalars(tmp_path, "return") == [(20, -1.0)]


def test_a_resumed_run_repeats_no_step(tmp_path):
    writer = open_writer(tmp_path)
    for step in (10, 20, 30, 40):
        writer.write(step, {"loss": 1.0})
    writer.close()
    writer = open_writer(tmp_path, resume_from=20)
    for step in (30, 40):
        writer.write(step, {"loss": 2.0})
    writer.close()
    curves = read_curves(tmp_path / "curves.csv")
    assert curves["updates"].tolist() == [10, 20, 30, 40]
    assert curves["loss"].tolist() == [1, 1, 2, 2]
    assert np.isnan(curves["return"]).all()
    assert scalars(tmp_path, "loss") == [(10, 1.0), (20, 1.0), (30, 2.0), (40, 2.0)]


def test_a_row_cut_short_by_a_kill_is_dropped(tmp_path):
    writer = open_writer(tmp_path)
    writer.write(10, {"loss": 1.0, "return": 2.0})
    writer.close()
    with (tmp_path / "curves.csv").open("a") as file:
        file.write("20,3.14")
    writer = open_writer(tmp_path, resume_from=100)
    writer.write(20, {"loss": 3.0})
    writer.close()
    assert read_curves(tmp_path / "curves.csv")["loss"].tolist() == [1, 3]


def test_rows_are_readable_while_the_run_goes_on(tmp_path):
    writer = open_writer(tmp_path)
    writer.write(10, {"loss": 1.0})
    assert read_curves(tmp_path / "curves.csv")["updates"].tolist() == [10]
    writer.close()


def test_refusals(tmp_path):
    writer = open_writer(tmp_path)
    with pytest.raises(ValueError, match="no column nonsense"):
        writer.write(1, {"nonsense": 1.0})
    writer.close()
    with pytest.raises(CurvesError, match="exists already"):
        open_writer(tmp_path)
    with pytest.raises(CurvesError, match="other columns"):
        open_writer(tmp_path, resume_from=0, columns=("other",))
    with pytest.raises(CurvesError, match="No such file"):
        read_curves(tmp_path / "nothing.csv")
    (tmp_path / "curves.csv").write_text("")
    with pytest.raises(CurvesError, match="not a file of training curves"):
        read_curves(tmp_path / "curves.csv")


@pytest.mark.parametrize("rows", [0, 50])
def test_the_picture_is_drawn(tmp_path, rows):
    writer = open_writer(tmp_path)
    for step in range(rows):
        writer.write(step, {"loss": 1.0 / (step + 1)})
    writer.close()
    plot_curves(tmp_path / "curves.csv", tmp_path / "plots" / "curves.png", title="run")
    data = (tmp_path / "plots" / "curves.png").read_bytes()
    assert data.startswith(b"\x89PNG") and len(data) > 3000 * (rows > 0)
