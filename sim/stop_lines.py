"""Lines to stop at: red and yellow lights and stop signs on the own path ahead.

A light counts where its stop point lies on the path and so does the light's lane behind
it (`Bank.light_through`): of two lanes that part at a line with a light each, only the
own one's counts, and no light of a crossing road does.

- Red (arrows too): stop, if braking up to `red_braking` can.
- Yellow: stop, if braking up to `yellow_braking` can. That is more than the driver's
  comfortable braking, so that who has begun to stop goes on to.
- Stop signs and flashing red: stop, stand, go. Nothing but the last H states tells how
  far an object is in this: within `zone` of the line it must have stood in all of them,
  after which it is let go as long as it gets faster; whoever brakes there again stops
  again. `zone` ends where a start from it, at `leaving`, has to have the speed.
- Green, flashing yellow, and lights whose state was not recorded: go.

A line is over once the front bumper is `overrun` past it; up to there it holds who
stands or can still stop: recorded drivers stop beyond the lines, too.
"""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim import paths
from sim.bank import Bank
from sim.paths import Corridor
from sim.scene import LightState

STANDING = 0.1  # m/s


@dataclass(frozen=True)
class StopConfig:
    """How a driver stops at lines."""

    red_braking: float = 6.0
    """A red light is passed only if stopping would need more [m/s^2]."""
    yellow_braking: float = 3.0
    """A yellow light is passed if stopping would need more [m/s^2]."""
    gap: float = 1.0
    """From the front bumper to the line where it stops [m]."""
    overrun: float = 1.5
    """So far past the bumper [m] a line still holds."""
    aside: float = 1.5
    """A line is on the path if it is at most so far from it [m]."""
    aside_behind: float = 2.5
    """So is a light's lane behind the line, where paths are less alike."""
    zone: float = 2.0
    """Within this of a stop sign's line [m] who has stood may go."""
    leaving: float = 2.0
    """Who leaves a stop sign gets faster by at most this [m/s^2]."""


def gap_to_stop(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    history: Float[Array, "history 5"],
    corridor: Corridor,
    config: StopConfig,
) -> Float[Array, ""]:
    """From the front bumper to the nearest line that holds the object now; inf: none.

    `history` holds the object's states (x, y, yaw, v_x, v_y), oldest first.
    """
    speeds = jnp.hypot(history[:, 3], history[:, 4])
    gap, on_path = _lights_on(bank, scene, corridor, config)
    light = bank.light_state[scene, step].astype(jnp.int32)
    needed = speeds[-1] ** 2 / (2.0 * jnp.maximum(gap, 0.1))
    red = (light == LightState.STOP) | (light == LightState.ARROW_STOP)
    yellow = (light == LightState.CAUTION) | (light == LightState.ARROW_CAUTION)
    flashing = light == LightState.FLASHING_STOP
    holds = (
        (red & (needed <= config.red_braking))
        | (yellow & (needed <= config.yellow_braking))
        | (flashing & sign_holds(gap, speeds, config))
    )
    lights = jnp.where(on_path & holds, gap, jnp.inf).min()
    line = bank.stop_position[scene]
    at = paths.crossings(corridor, line[:, 0], line[:, 1], config.overrun)
    there = jnp.arange(line.shape[0]) < bank.stops[scene]
    held = there & (at.aside <= config.aside) & sign_holds(at.gap, speeds, config)
    return jnp.minimum(lights, jnp.where(held, at.gap, jnp.inf).min())


def _lights_on(
    bank: Bank, scene: Int[Array, ""], corridor: Corridor, config: StopConfig
) -> tuple[Float[Array, " lights"], Bool[Array, " lights"]]:
    """The gap to every light's line, and whether it is the own path's."""
    line, behind = bank.light_position[scene], bank.light_through[scene]
    at = paths.crossings(corridor, line[:, 0], line[:, 1], config.overrun)
    then = paths.crossings(corridor, behind[:, 0], behind[:, 1], config.overrun)
    there = jnp.arange(line.shape[0]) < bank.lights[scene]
    # Behind a line means farther along, but for a light without a known lane.
    parted = jnp.hypot(behind[:, 0] - line[:, 0], behind[:, 1] - line[:, 1])
    onward = (then.gap > at.gap) | (parted < 0.1)
    on_path = (at.aside <= config.aside) & (then.aside <= config.aside_behind)
    return at.gap, there & onward & on_path


def sign_holds(
    gap: Float[Array, " lines"], speeds: Float[Array, " history"], config: StopConfig
) -> Bool[Array, " lines"]:
    """Whether a stop sign holds an object with these last speeds [m/s], oldest first.

    It does until the object has stood within `zone` of the line, and no longer while it
    leaves from there: gets faster, but is no faster than a start from `zone` makes it.
    """
    now = speeds[-1]
    stood = (speeds < STANDING).all()
    faster = now > speeds[-2]
    reached = now**2 <= 2.0 * config.leaving * jnp.maximum(config.zone - gap, 0.0)
    return (gap > config.zone) | ~(stood | (faster & reached))
