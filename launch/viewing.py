"""The options of `slipstream view` and of the viewer's role."""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from launch.errors import LaunchError
from launch.signals import Asked

if TYPE_CHECKING:
    from launch.viewer import ViewerConfig


@dataclass(frozen=True, kw_only=True)
class PageConfig:
    """What is shown, and where."""

    shown: int = 4
    """Environments of a live run that are shown."""
    host: str = "127.0.0.1"
    """Address to bind; others than loopback need --insecure."""
    web_port: int = 9090
    """Port of the page to open."""
    data_port: int = 9876
    """Port that the page has its data from."""


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """Shows a run in progress, live, or a recording."""

    target: tyro.conf.Positional[Path]
    """A run's folder or an .rrd file."""
    page: tyro.conf.OmitArgPrefixes[PageConfig]
    """What is shown, and where."""
    insecure: bool = False
    """Allows addresses other than loopback; nothing is encrypted."""


def viewer_config(page: PageConfig, insecure: bool) -> "ViewerConfig":
    """The viewer's settings; refuses where Rerun is not installed."""
    try:
        from launch.viewer import ViewerConfig
        from launch.web import WebConfig
    except ImportError as error:
        raise LaunchError(
            f"the viewer needs Rerun ({error}): pip install 'slipstream[viewer]'"
        ) from error
    web = WebConfig(
        host=page.host,
        web_port=page.web_port,
        data_port=page.data_port,
        insecure=insecure,
    )
    return ViewerConfig(environments=page.shown, web=web)


def view_command(options: ViewConfig) -> int:
    """`slipstream view`."""
    config = viewer_config(options.page, options.insecure)
    from launch.view import view

    asked = Asked()
    asked.listen(grace_s=5.0)
    announce = functools.partial(print, "open", flush=True)
    view(options.target, config, stop=asked.stop, announce=announce)
    return asked.exit_code
