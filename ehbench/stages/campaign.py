"""Several recipes in order, then one report; a rejected or stopped run is shown too."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ehbench.config.recipe import Campaign, load_recipe
from ehbench.report.provenance import unsupported
from ehbench.runs import rundir
from ehbench.runs.versions import Versions
from ehbench.runtime.disk import write_text
from ehbench.stages.base import DONE, INCOMPLETE, Host, Outcome, Prepared, Stage, stage_of
from ehbench.stages.inputs import Inputs
from ehbench.vocabulary import InputError, message, plural


@dataclass(frozen=True)
class PreparedCampaign(Prepared):
    """The recipe files to run, in order."""

    recipe: Campaign
    files: tuple[Path, ...]


class CampaignStage(Stage[Campaign, PreparedCampaign]):
    """`Campaign`."""

    name = "campaign"
    command = "reproduce"
    writes = "one report.html over all runs, each of which has a folder of its own"

    def prepare(self, recipe: Campaign, inputs: Inputs) -> PreparedCampaign:
        notes, files = inputs.notes, []
        shared: dict[str, dict[str, list[str]]] = {"remarks": {}, "undecided": {}}
        for index, name in enumerate(recipe.recipes):
            with notes.collected():
                files.append(inputs.existing(name))
                item = load_recipe(files[-1])
                if not stage_of(item).command:
                    text = message("stages.not_in_campaign", name=name, stage=item.stage_name)
                    raise InputError(text, **recipe.at("recipes", index))
                if inputs.check is None:
                    continue
                result = inputs.check(files[-1])
                text = f"{name}: {result.does}"
                if result.is_current:
                    text = message("stages.folder_is_current", name=text)
                notes.reads.append(text)
                for kind, texts in shared.items():
                    for text in getattr(result, kind):
                        texts.setdefault(text, []).append(name)
                notes.add("losses", *result.losses)
                notes.options |= result.options
                for error in result.errors:
                    notes.add_error(error)
        for kind, texts in shared.items():  # a note of several recipes once, with their names
            notes.add(kind, *(f"{', '.join(names)}: {text}" for text, names in texts.items()))
        if recipe.figures:
            notes.add("undecided", message("stages.figures_of_runs"))
        does = message("stages.does_campaign", recipes=plural(len(recipe.recipes), "recipe"))
        return PreparedCampaign(recipe, None, does, tuple(files))

    def run(self, prepared: PreparedCampaign, host: Host) -> Outcome:
        recipe, progress, outcomes = prepared.recipe, host.progress_of(prepared.recipe.name), []
        for index, (name, path) in enumerate(zip(recipe.recipes, prepared.files, strict=True)):
            if progress is not None:
                progress(name, index / len(recipe.recipes))
            outcomes.append(host.outcome_of(path))
        page = write_report([outcome.folder for outcome in outcomes], host, recipe)
        notes = (f"{run.folder.name}: {note}" for run in outcomes for note in run.notes)
        code = max(page.code, *(run.code for run in outcomes))
        return Outcome(page.folder, code, (*page.notes, *notes))


def write_report(folders: Sequence[Path], host: Host, campaign: Campaign | None = None) -> Outcome:
    """Run folders → one self-contained ``report.html``; reads saved files only.

    Raises:
        InputError: a folder is no whole run, or lacks what its section needs."""
    from ehbench.report import build

    for folder in folders:
        if not rundir.is_whole(folder):
            raise InputError(message("stages.no_whole_run"), file=folder)
    inputs = [("run", folder) for folder in folders]
    source = campaign.path if campaign else folders[0] / "run.json"
    name = campaign.name if campaign else "report"
    digest = rundir.hash_of(source, inputs, Versions.of("report"))
    final = host.out or host.root / f"{name}_{digest}"
    progress = host.progress_of(campaign.name if campaign else "")
    if progress is not None:
        progress("writing the report", 0.5)
    with rundir.open_run(final, "report", source, inputs) as run:
        page = build(folders, campaign)
        write_text(run.path / "report.html", page)
    changes = [text for folder in folders for text in unsupported(folder)]
    return Outcome(run.final, INCOMPLETE if changes else DONE, (*changes, *run.left_over))
