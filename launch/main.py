"""The command line. The dataclasses of the configuration are its options.

A command's module is imported when the command is named: `slipstream --help` loads
neither jax nor torch (which is why this is a table and not tyro's SubcommandApp, whose
types have to be there to be listed). A user's mistake is one line on standard error
and exit code 2; Ctrl-C is 130; a traceback is a bug.
"""

import contextlib
import io
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import tyro

from launch.devices import share_gpu
from launch.errors import INTERRUPTED, USER_ERROR, LaunchError, user_message


@final
@dataclass(frozen=True)
class Command:
    """One command: `run` takes what follows its name and returns the exit code."""

    summary: str
    run: Callable[[list[str], str], int]


def _parse(options: Any, words: Sequence[str], prog: str, **settings: Any) -> Any:  # noqa: ANN401
    """Parses a command's options; a mistake becomes one line."""
    boxed = io.StringIO()
    try:
        with contextlib.redirect_stderr(boxed):
            return tyro.cli(options, prog=prog, args=list(words), **settings)
    except SystemExit as ended:
        if not ended.code:
            raise
        command = prog.removeprefix("slipstream ")
        raise LaunchError(f"{command}: {_one_line(boxed.getvalue())}") from None
    except ValueError as error:  # of a configuration's own check
        raise LaunchError(str(error)) from error


def _one_line(box: str) -> str:
    """The words of an error that tyro drew a box around."""
    lines = [line.strip(" │╭╮╰╯─|+-\n") for line in box.splitlines()]
    text = re.sub(r"\s+", " ", " ".join(line for line in lines if line))
    text = re.sub(r"\x1b\[[0-9;]*m|[─━═]{2,}", " ", text)
    text = re.sub(r"^\W*(Parsing error|Value error|Missing argument) ", "", text)
    text = re.sub(r"^Required options Missing from [^:]*: (\w)", r"missing --\1", text)
    text = re.sub(r"^Unrecognized options (?=Unrecognized)", "", text)
    text = re.sub(r"^Invalid choice (?=invalid choice)", "", text)
    text = re.sub(r" *(Argument helptext|For full helptext).*$", "", text)
    return f"{text.strip() or 'cannot be parsed'}; see --help"


def _train(words: list[str], prog: str) -> int:
    from launch.config import PRESETS
    from launch.train import TrainConfig, train_command

    preset = _value_of(words, "--preset", "quick")
    if preset not in PRESETS:
        raise LaunchError(
            f"--preset {preset}: unknown; choose one of {', '.join(PRESETS)}"
        )
    default = TrainConfig(preset=preset, config=PRESETS[preset]())  # type: ignore[arg-type]
    return train_command(_parse(TrainConfig, words, prog, default=default))


def _train_bc(words: list[str], prog: str) -> int:
    from launch.config import CLONING_PRESETS
    from launch.train_bc import TrainBcConfig, train_bc_command

    preset = _value_of(words, "--preset", "quick")
    if preset not in CLONING_PRESETS:
        raise LaunchError(
            f"--preset {preset}: unknown; choose one of {', '.join(CLONING_PRESETS)}"
        )
    config = CLONING_PRESETS[preset]()
    default = TrainBcConfig(preset=preset, config=config)  # type: ignore[arg-type]
    return train_bc_command(_parse(TrainBcConfig, words, prog, default=default))


def _value_of(words: Sequence[str], name: str, default: str) -> str:
    """An option's value, before all options can be parsed."""
    for index, word in enumerate(words):
        if word == name and index + 1 < len(words):
            return words[index + 1]
        if word.startswith(f"{name}="):
            return word.removeprefix(f"{name}=")
    return default


def _evaluate(words: list[str], prog: str) -> int:
    from launch.evaluate import EvaluateConfig, evaluate_command

    return evaluate_command(_parse(EvaluateConfig, words, prog))


def _convert(words: list[str], prog: str) -> int:
    from launch.scenes import ConvertConfig, convert_command

    return convert_command(_parse(ConvertConfig, words, prog))


def _info(words: list[str], prog: str) -> int:
    from launch.scenes import InfoConfig, info_command

    return info_command(_parse(InfoConfig, words, prog))


def _procedural(words: list[str], prog: str) -> int:
    from launch.scenes import ProceduralConfig, procedural_command

    return procedural_command(_parse(ProceduralConfig, words, prog))


def _pipeline(words: list[str], prog: str) -> int:
    from launch.bench import PipelineConfig, pipeline_command

    return pipeline_command(_parse(PipelineConfig, words, prog))


def _sim(words: list[str], prog: str) -> int:
    from launch.bench_sim import SimConfig, sim_command

    return sim_command(_parse(SimConfig, words, prog))


def _bench_learner(words: list[str], prog: str) -> int:
    from launch.bench_learner import BenchLearnerConfig, bench_learner_command

    return bench_learner_command(_parse(BenchLearnerConfig, words, prog))


def _replay_bench(words: list[str], prog: str) -> int:
    from launch.bench_replay import ReplayBenchConfig, replay_command

    return replay_command(_parse(ReplayBenchConfig, words, prog))


def _doctor(words: list[str], prog: str) -> int:
    from launch.doctor import DoctorConfig, doctor_command

    return doctor_command(_parse(DoctorConfig, words, prog))


def _view(words: list[str], prog: str) -> int:
    from launch.viewing import ViewConfig, view_command

    return view_command(_parse(ViewConfig, words, prog))


def _replay_stats(words: list[str], prog: str) -> int:
    from launch.replay_stats import StatsConfig, stats_command

    return stats_command(_parse(StatsConfig, words, prog))


def _metrics(words: list[str], prog: str) -> int:
    from launch.metrics import MetricsConfig, metrics_command

    return metrics_command(_parse(MetricsConfig, words, prog))


def _export(words: list[str], prog: str) -> int:
    from launch.export import ExportConfig, export_command

    return export_command(_parse(ExportConfig, words, prog))


def _sweep(words: list[str], prog: str) -> int:
    from launch.sweep import SweepConfig, sweep_command

    # What follows `--` is not the sweep's: each run gets it.
    cut = words.index("--") if "--" in words else len(words)
    options = _parse(SweepConfig, words[:cut], prog)
    return sweep_command(prog.rsplit(" ", 1)[1], options, words[cut + 1 :])


def _role(words: list[str], prog: str) -> int:
    from launch.processes import run_role

    name = prog.rsplit(" ", 1)[1]
    return run_role(name, lambda options: _parse(options, words, prog))


COMMANDS: Final = {
    "train dqn": Command("trains an agent, scores and records it", _train),
    "train bc": Command("clones what the scenes' drivers did", _train_bc),
    "evaluate": Command("drives scenes with an agent and judges it", _evaluate),
    "scenes convert": Command("converts recorded scenes into a bank", _convert),
    "scenes info": Command("says what a bank or scene files hold", _info),
    "scenes procedural": Command("generates scenes into a bank", _procedural),
    "view": Command("shows a run in progress or a recording", _view),
    "bench sim": Command("measures the simulator", _sim),
    "bench learner": Command("measures the learner's updates", _bench_learner),
    "bench replay": Command("measures the replay service", _replay_bench),
    "bench pipeline": Command("measures a run of the quick preset", _pipeline),
    "sweep bc": Command("clones at each point of the paper's grid", _sweep),
    "sweep dqn": Command("trains double DQN at each point of the grid", _sweep),
    "sweep all": Command("both grids, and one table of both", _sweep),
    "replay stats": Command("says how a run's replay fares", _replay_stats),
    "replay metrics": Command("serves the same to Prometheus", _metrics),
    "replay export": Command("writes a replay to a file for offline RL", _export),
    "replay": Command("one role of a run: the replay service", _role),
    "actor": Command("one role of a run: an actor", _role),
    "learner": Command("one role of a run: the learner", _role),
    "filler": Command("one role of a run: it replays the expert", _role),
    "evaluator": Command("one role of a run: it drives new checkpoints", _role),
    "viewer": Command("one role of a run: the live viewer", _role),
    "doctor": Command("says what works on this machine", _doctor),
}


def usage() -> str:
    """The list of commands."""
    lines = ["usage: slipstream COMMAND [OPTIONS]; each has --help", ""]
    lines += [f"  {name:<20}{command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(lines)


def find(words: list[str]) -> tuple[str, list[str]]:
    """Splits what was typed into the command's name and its options."""
    for length in (2, 1):
        name = " ".join(words[:length])
        if name in COMMANDS:
            return name, words[length:]
    first = words[0]
    nested = [name.split()[1] for name in COMMANDS if name.split()[0] == first]
    if not nested:
        raise LaunchError(f"{first}: no such command; see slipstream --help")
    given = words[1] if len(words) > 1 else "nothing"
    raise LaunchError(f"{first}: expected {' or '.join(nested)} and not {given}")


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in {"-h", "--help", "help"}:
        print(usage())
        return 0 if words else USER_ERROR
    name, rest = find(words)
    return COMMANDS[name].run(rest, f"slipstream {name}")


def main(words: Sequence[str] | None = None) -> int:
    """Runs a command; the exit code."""
    share_gpu()
    try:
        return _dispatch(list(sys.argv[1:] if words is None else words))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # of `| head`
        return 0
    except Exception as error:
        message = user_message(error)
        if message is None:
            raise
        print(f"slipstream: {message}", file=sys.stderr)
        return USER_ERROR
