"""One bad record among many: it is left out, counted and named; where many are bad, the whole is refused."""

from collections.abc import Sequence

from f3amd_lib.ground import log

MOST_BROKEN = 0.2
"""Share of a data set's records that may be broken."""


def leave_out(
    where, broken: Sequence[tuple[str, str]], num_records: int, parts: Sequence[tuple[str, str]] = ()
) -> None:
    """Say which records of a data set are left out: how many, and the first three with their reasons.

    Args:
      where: name or place of the data set.
      broken: those that nothing is left of.
      num_records: all of them.
      parts: parts of others, which do not count as broken.

    Raises:
      ValueError: if more than `MOST_BROKEN` are broken.
    """
    every = [*broken, *parts]
    named = "; ".join(f"{record}: {reason}" for record, reason in every[:3]) + ("; ..." if len(every) > 3 else "")
    if len(broken) > MOST_BROKEN * num_records:
        what = f"{len(broken)} of {num_records} records are broken, more than {MOST_BROKEN:.0%}"
        raise ValueError(f"{where}: {what}; fix or remove them: {named}")
    if every:
        of_parts = f", and {len(parts)} parts of others" if parts else ""
        log.warning(
            "%s: %d of %d records are broken and left out%s: %s", where, len(broken), num_records, of_parts, named
        )
