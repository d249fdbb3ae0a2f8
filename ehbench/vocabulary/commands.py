"""The commands that run a recipe, one row each; every stage names the one that runs its recipes.

A table by itself, so that ``ehbench --help`` need not load the stages."""

from typing import NamedTuple


class Command(NamedTuple):
    """A command: name, help, an example's recipe, options besides those of all."""

    name: str
    help: str
    example: str
    options: tuple[str, ...] = ()


COMMANDS = (
    Command(
        "identify",
        "Identify flow maps or hydraulics from the data a recipe names.",
        "recipes/thesis/flow_maps.toml",
        ("suggest", "seconds", "profile", "resume", "allow_code"),
    ),
    Command(
        "response",
        "Estimate a frequency response from logs, with intervals, delay and bandwidth.",
        "recipes/slide_servo/response.toml",
        ("allow_code",),
    ),
    Command(
        "validate",
        "Judge an identified rig on logs it was not fitted to; exit 4 when it is rejected.",
        "recipes/thesis/validation.toml",
        ("allow_code",),
    ),
    Command(
        "tune",
        "Choose a controller's gains by root locus over postures, loads and functions, on a "
        "validated rig.",
        "recipes/thesis/tuning.toml",
        ("unvalidated", "allow_code"),
    ),
    Command(
        "run-trial",
        "Run a trial on the model, the virtual bench or a machine, or a set of trials; exit 5 when "
        "a limit stops one.",
        "recipes/trials/arc_slow.toml",
        ("allow_code", "unvalidated", "on", "arm", "token", "live"),
    ),
    Command(
        "study",
        "Run a recipe over many samples of what is not known or not chosen, on this machine or a "
        "Dask cluster.",
        "recipes/studies/stopping.toml",
        (
            *("allow_code", "unvalidated", "workers", "tls_ca_file", "tls_cert", "tls_key"),
            *("insecure_workers", "resume"),
        ),
    ),
)
