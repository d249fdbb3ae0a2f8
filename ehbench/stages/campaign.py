"""Several recipes in order, then one report over their runs. A rejected or stopped run is shown,
not dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ehbench.config.recipe import Campaign, load_recipe
from ehbench.runs import rundir
from ehbench.runs.versions import Versions
from ehbench.stages.base import DONE, INCOMPLETE, Host, Outcome, Prepared, Stage, Work, stage_of
from ehbench.stages.findings import STANDS, counted
from ehbench.stages.inputs import Inputs
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.progress import Progress


@dataclass(frozen=True)
class PreparedCampaign(Prepared):
    """The recipe files to run, in order."""

    recipe: Campaign
    files: tuple[Path, ...]


class CampaignStage(Stage[Campaign, PreparedCampaign]):
    """`Campaign`."""

    recipe = Campaign
    name = "campaign"
    command = "reproduce"
    writes = "one report.html over all runs, each of which has a folder of its own"

    def prepare(self, recipe: Campaign, inputs: Inputs) -> PreparedCampaign:
        findings, files = inputs.findings, []
        texts_of: dict[str, dict[str, list[str]]] = {"notes": {}, "open": {}}
        for index, name in enumerate(recipe.recipes):
            with findings.noting():
                files.append(inputs.existing(name))
                behind = load_recipe(files[-1])
                if not isinstance(stage_of(behind), Stage):
                    raise InputError(
                        f"'{name}' is of stage '{behind.stage_name}', which no campaign runs",
                        **recipe.at("recipes", index),
                    )
                self._gather(name, files[-1], inputs, texts_of)
        for kind, texts in texts_of.items():
            findings.say(kind, *(f"{', '.join(names)}: {text}" for text, names in texts.items()))
        if recipe.figures:
            findings.say("open", "the names under [figures]: the runs make them")
        does = f"runs {counted(recipe.recipes, 'recipe')} in order; those that stand are kept"
        return PreparedCampaign(recipe, None, does, tuple(files))

    @staticmethod
    def _gather(
        name: str, path: Path, inputs: Inputs, texts_of: dict[str, dict[str, list[str]]]
    ) -> None:
        """What a check finds of one recipe; notes that several have are told once, with their
        names.
        """
        findings, behind = inputs.findings, inputs.runs.findings(path)
        if behind is None:
            return
        findings.reads.append(f"{name}: {behind.does}" + f", {STANDS}" * behind.stands)
        for kind, texts in texts_of.items():
            for text in getattr(behind, kind):
                texts.setdefault(text, []).append(name)
        findings.say("losses", *behind.losses)
        for error in behind.errors:
            findings.mistake(error)

    def work(self, prepared: PreparedCampaign, folder: Path, progress: Progress | None) -> Work:
        raise NotImplementedError("a campaign's work is that of its recipes")

    def run(self, prepared: PreparedCampaign, host: Host) -> Outcome:
        recipe, tell, outcomes = prepared.recipe, host.tell(prepared.recipe.name), []
        for index, (name, path) in enumerate(zip(recipe.recipes, prepared.files, strict=True)):
            if tell is not None:
                tell(name, index / len(recipe.recipes))
            outcomes.append(host.outcome_of(path))
        page = write_report([outcome.folder for outcome in outcomes], host, recipe)
        notes = (f"{run.folder.name}: {note}" for run in outcomes for note in run.notes)
        code = max(page.code, *(run.code for run in outcomes))
        return Outcome(page.folder, code, (*page.notes, *notes))


def write_report(folders: Sequence[Path], host: Host, campaign: Campaign | None = None) -> Outcome:
    """Run folders → one self-contained ``report.html``; reads saved files only.

    Raises:
        InputError: a folder is no whole run, or lacks what its section needs.
    """
    from ehbench.report import build
    from ehbench.report.bearing import no_longer_bears

    for folder in folders:
        if not rundir.is_whole(folder):
            raise InputError(
                "is no whole run folder",
                file=folder,
                hint="name folders that hold a run.json and all outputs it lists",
            )
    inputs = [("run", folder) for folder in folders]
    source = campaign.path if campaign else folders[0] / "run.json"
    name = campaign.name if campaign else "report"
    digest = rundir.hash_of(source, inputs, Versions.of("report"))
    final = host.out or host.root / f"{name}_{digest}"
    tell = host.tell(campaign.name if campaign else "")
    if tell is not None:
        tell("writing the report", 0.5)
    with rundir.open_run(final, "report", source, inputs) as run:
        page = build(folders, campaign)
        (run.path / "report.html").write_text(page, encoding="utf-8")
    marks = [text for folder in folders for text in no_longer_bears(folder)]
    return Outcome(run.final, INCOMPLETE if marks else DONE, (*marks, *run.left_over))
