"""The commands about links: the layout of packets, the quality of a link, a served machine."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ehbench import workflow
from ehbench.config.recipe import BenchRecipe, Recipe, TrialRecipe, kind_of, load_recipe, load_rig
from ehbench.links import layout, responder
from ehbench.links.opening import CARDS, Address
from ehbench.links.quality import measure
from ehbench.links.serve import LINK_FAULTS, ServedTarget, serve_virtual
from ehbench.report.blocks import Grid
from ehbench.report.terminal import Answer
from ehbench.runtime.realtime import punctual
from ehbench.stages.trial import TrialStage
from ehbench.trial.preparation import Prepared
from ehbench.vocabulary import InputError, message
from ehbench.vocabulary.fields import Value

SERVING = 50  # priority: below that of a host in the same computer


def moved_to(recipe: Recipe | None, url: str) -> TrialRecipe:
    """A trial on the machine at a URL.

    Raises:
        InputError: it is no single trial, or no URL."""
    if not isinstance(recipe, TrialRecipe):
        raise InputError(message("links.only_trial"))
    return recipe.model_copy(update={"on": Address.of(url).url})


def wire(rig: Path, kinds: Sequence[str], rate: float, out: Path | None) -> str:
    """The layout of a rig's packets of each kind, or the names of the files that were written.

    Raises:
        InputError: the file is none of a rig."""
    if rig.is_file() and (kind := kind_of(rig)) != "rig":
        raise InputError(message("links.wire_rig", kind=kind), file=rig)
    built = layout.Layout.of(load_rig(rig))
    if out is None:
        return "".join(layout.WRITERS[kind][1](built, rate) for kind in kinds)
    written = [path for kind in kinds for path in layout.write_files(built, rate, kind, out)]
    return "".join(f"{path}\n" for path in written)


def measured(url: str, seconds: float) -> tuple[Answer, int]:
    """(what to say of a link, exit code) after it was measured for some seconds."""
    with punctual() as refused:
        quality = measure(Address.of(url).link(), url, seconds, tuple(refused))
    problems = quality.problems()
    values: dict[str, Any] = vars(quality) | {"late_share": quality.late_share}
    verdict = "; ".join(problems) or message("links.sound")
    return Answer(verdict, [Grid(["", ""], quality.rows())], values=values), 4 if problems else 0


def served(
    file: Path,
    on: str | None,
    rate: float | None,
    watchdog: float | None = None,
    allow_code: bool = False,
) -> tuple[Prepared, ServedTarget]:
    """A trial's machine, or that of a bench file, as a target; the trial beside it.

    Raises:
        InputError: another kind of file."""
    recipe = load_recipe(file)
    if isinstance(recipe, BenchRecipe):
        keys: dict[str, Any] = {"rig": recipe.rig, "bench": recipe.path.name, "on": "bench"}
        recipe = TrialRecipe(stage="trial", path=recipe.path, duration=Value(1.0), **keys)
    if not isinstance(recipe, TrialRecipe):
        raise InputError(message("links.no_bench"), file=file)
    place = on or (recipe.on if "://" not in recipe.on else "bench" if recipe.bench else "model")
    links = tuple(fault for fault in recipe.fault if fault.kind in LINK_FAULTS)
    others = tuple(fault for fault in recipe.fault if fault not in links)
    changes: dict[str, Any] = {"on": place, "fault": others}
    changes |= {} if rate is None else {"rate": Value(rate)}
    recipe = recipe.model_copy(update=changes)
    session = workflow.Session(allow_code=allow_code)
    trial = TrialStage().prepare(recipe, session.inputs(recipe)).trial
    return trial, ServedTarget(trial, links, watchdog)


def serve(
    file: Path,
    url: str,
    on: str | None,
    rate: float | None,
    watchdog: float | None,
    allow_code: bool,
) -> None:
    """Serve a trial's machine, or that of a bench file, until a signal ends it.

    Raises:
        InputError: another kind of file, a URL that cannot be served."""
    address = Address.of(url)
    if address.scheme in CARDS:
        raise InputError(message("links.card", url=url))
    trial, target = served(file, on, rate, watchdog, allow_code)
    fields = {"machine": trial.machine.name, "rig": trial.rig.name, "url": url}
    names = layout.Layout.of(trial.rig).names(address.mode)

    def ready() -> None:
        print(message("links.serving", rate=target.rate, **fields), file=sys.stderr, flush=True)

    try:
        if address.scheme == "modbus":
            from ehbench.links import modbus

            place = (address.host, address.port)
            modbus.serve(target, place, names, address.map, address.virtual, ready)
        elif address.scheme == "can" and address.map is not None:
            from ehbench.links import can

            can.serve(target, address.host, address.channel, names, address.map, ready)
        else:
            if address.virtual:
                serve_virtual(target, address.port, address.host, ready)
            with punctual(SERVING, pinned=False):
                responder.serve(target, address.port, address.host, ready)
    except OSError as error:
        raise InputError(message("links.system", url=url, why=error.strerror or error)) from error
