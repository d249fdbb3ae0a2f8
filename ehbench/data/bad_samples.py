"""Bad samples of a foreign file: refused, bridged, or left out with their rows."""

from pathlib import Path

import numpy as np

from ehbench.config.recipe.columns import LEAVE_OUT, ColumnMap
from ehbench.data.rates import SETTINGS, Group, Window, in_window, is_bad, lines_text, range_of
from ehbench.data.record import resampled
from ehbench.signals.series import stretches_of
from ehbench.vocabulary import Message, from_si, listed, message, plural, quantity
from ehbench.vocabulary.errors import LogError, UnitError


def clean(
    group: Group, columns: ColumnMap, path: Path, window: Window | None, losses: list[str]
) -> Group:
    """Refuse bad samples inside of the window, or give the group without them, as the map says: a
    few in a row are bridged, of more the rows are gone.

    Raises:
        LogError, UnitError: a bad sample that the map does not allow; no row has a time.
    """
    count = np.arange(group.t.size)
    timed = np.isfinite(group.t)
    if not timed.any():
        raise LogError(message("data.no_row_timed"), file=path)
    t = np.interp(count, count[timed], group.t[timed])
    inside = in_window(t, window)
    policies = {item.channel: item.bad_samples for item in columns.columns.names.values()}
    general = columns.columns.bad_samples
    if (lost := np.flatnonzero(~timed & inside)).size:
        if general != LEAVE_OUT:
            text = message("data.row_without_time")
            odd = next(iter(group.columns.values())).odd.get(int(lost[0]))
            line, hint = group.line(lost[0]), text.hint
            text = odd if isinstance(odd, Message) else text  # of the whole row
            raise LogError(text, file=path, line=line, hint=hint)
        rows, lines = plural(lost.size, "row"), lines_text(group, lost)
        losses.append(message("data.rows_without_time", rows=rows, lines=lines))
    gone = ~timed
    for channel, values in group.channels.items():
        travel = columns.travels.get(channel)
        bad = is_bad(channel, values, travel)
        if not bad.any():
            continue
        at = np.flatnonzero(bad & inside & timed)
        if at.size and (policies.get(channel) or general) != LEAVE_OUT:
            raise _bad_sample(group, channel, int(at[0]), path, travel)
        bridged = bad & _short(bad) & ~gone
        if bridged.any():
            good = {channel: values[~bad]}
            values[bridged] = resampled(good, count[~bad], count[bridged])[channel]
        gone |= bad & ~bridged & inside
        for some, is_bridged in ((at[bridged[at]], True), (at[~bridged[at]], False)):
            if some.size:
                losses.append(_left_out(channel, group, t, some, is_bridged))
    return group.taken(np.flatnonzero(~gone)) if gone.any() else group


def _short(bad: np.ndarray) -> np.ndarray:
    """Where a run of bad samples is short enough to be bridged, with good ones at both ends."""
    result = np.zeros(bad.size, bool)
    for start, stop in stretches_of(bad):
        few = stop - start <= SETTINGS.bridged
        result[start:stop] = few and start > 0 and stop < bad.size
    return result


def _left_out(channel: str, group: Group, t: np.ndarray, at: np.ndarray, is_bridged: bool) -> str:
    """A note on samples that are left out."""
    samples, lines = plural(at.size, "bad sample"), lines_text(group, at)
    if not is_bridged:
        first, last = t[at[0]], t[at[-1]]
        fields = {"channel": channel, "samples": samples, "lines": lines}
        return message("data.rows_left_out", first=first, last=last, **fields)
    some = listed(f"{item:.6g}" for item in t[at])
    key = "data.command_bridged" if channel.endswith(".command") else "data.samples_bridged"
    run = 1 + max(map(len, np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)))
    fields = {"share": at.size / t.size, "longest": run * group.period}
    return message(key, channel=channel, samples=samples, times=some, lines=lines, **fields)


def _bad_sample(
    group: Group, channel: str, at: int, path: Path, travel: float | None
) -> LogError | UnitError:
    """The error of a bad sample."""
    row, value, column = quantity(channel), group.channels[channel][at], group.columns[channel]
    line = group.line(at)
    where = "" if line else f" at t = {group.t[at]:.9g} s"
    if np.isfinite(value):
        low, high = range_of(channel, group.channels[channel], travel)
        ends = {"low": low, "high": high, "value": value}
        fields = {key: from_si(x, row.display, row) for key, x in ends.items()}
        fields |= {"channel": channel, "column": column.name, "unit": row.display}
        return UnitError(message("data.bad_value", where=where, **fields), file=path, line=line)
    odd = column.odd.get(at)
    what = f"is {value:g}" if odd is None else f"'{odd}' is no number" if odd else "is blank"
    what = odd if isinstance(odd, Message) else what
    text = message("data.bad_sample", channel=channel, what=what, where=where)
    return LogError(text, file=path, line=line)
