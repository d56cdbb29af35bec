"""The viewer's layout: drives from above on the left, plots and words on the right.

Every environment has a view whose origin is its `camera` entity, so that the
controlled object stays in the middle while the map moves below it, north up. The
panel on the right follows the first environment.
"""

from typing import Literal

import rerun as rr
import rerun.blueprint as rrb

HISTORY = 120  # steps that the plots look back
BACKGROUND = (20, 23, 28)
_EYE = (0.0, -28.0, 72.0)  # m from the controlled object
_TARGET = (0.0, 4.0, 0.0)  # m; a little ahead keeps the middle of the picture


def _drive(root: str, name: str) -> rrb.Spatial3DView:
    """An environment from above."""
    return rrb.Spatial3DView(
        origin=f"{root}/camera",
        contents=[f"{root}/**", f"- {root}/plots/**", f"- {root}/q_bars/**"],
        name=name,
        background=rrb.Background(color=BACKGROUND),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=_EYE,
            look_target=_TARGET,
            eye_up=(0.0, 0.0, 1.0),
        ),
    )


def _plot(
    root: str, plot: str, name: str, bounds: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    """One plot of the panel."""
    window = rrb.VisibleTimeRange(
        "step",
        start=rrb.TimeRangeBoundary.cursor_relative(seq=-HISTORY),
        end=rrb.TimeRangeBoundary.cursor_relative(seq=0),
    )
    return rrb.TimeSeriesView(
        origin=f"{root}/plots/{plot}",
        name=name,
        time_ranges=[window],
        axis_y=rrb.ScalarAxis(range=bounds) if bounds is not None else None,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )


def _panel(root: str) -> rrb.Vertical:
    """Words, Q-values and plots of one environment."""
    return rrb.Vertical(
        rrb.Horizontal(
            rrb.TextDocumentView(origin=f"{root}/about", name="Now"),
            rrb.BarChartView(
                origin=f"{root}/q_bars",
                name="Q-values above the lowest, by action",
                plot_legend=rrb.PlotLegend(visible=False),
            ),
        ),
        rrb.Horizontal(
            _plot(root, "speed", "Speed"),
            _plot(root, "reward", "Reward and return"),
        ),
        rrb.Horizontal(
            _plot(root, "progress", "Progress along the route", (0.0, 1.05)),
            _plot(root, "failures", "Failures", (0.0, 1.05)),
        ),
        _plot(root, "action", "Action"),
        row_shares=[1.45, 1, 1, 0.8],
    )


def layout(
    roots: list[str],
    *,
    play_state: Literal["playing", "following", "paused"],
    frames_per_second: float,
) -> rrb.Blueprint:
    """The blueprint for the environments below `roots`, the first one foremost."""
    drives = [_drive(root, root.replace("_", " ").strip("/")) for root in roots]
    views = drives[0] if len(drives) == 1 else rrb.Grid(*drives)
    return rrb.Blueprint(
        rrb.Horizontal(views, _panel(roots[0]), column_shares=[1.6, 1]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed",
            timeline="step",
            play_state=play_state,
            fps=frames_per_second,
        ),
        auto_views=False,
        auto_layout=False,
    )


def new_recording(name: str) -> rr.RecordingStream:
    """A recording of this application; `name` is what its list of recordings shows."""
    recording = rr.RecordingStream("slipstream")
    recording.send_recording_name(name)
    return recording
