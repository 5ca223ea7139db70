"""Fuzz all readers, or make one input again.

python -m tests.fuzzing --inputs 100000                    all readers
python -m tests.fuzzing --readers plans,ROS --inputs 500   some of them
python -m tests.fuzzing --readers plans --number 17        input 17 of one, in this process, with its traceback
"""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.fuzzing.campaign import Outcome, fuzz, shares
from tests.fuzzing.readers import READERS
from tests.fuzzing.worker import PROGRESS, Watch


def main() -> int:
    parser = argparse.ArgumentParser(description="Fuzz what cfplan reads.")
    parser.add_argument("--inputs", type=int, default=2000, help="of all readers together")
    parser.add_argument("--readers", default=",".join(READERS), help="names, with commas")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--number", type=int, help="use this one input of one reader")
    parser.add_argument("--folder", type=Path, help="where inputs and findings are kept")
    given = parser.parse_args()
    names = given.readers.split(",")
    folder = given.folder or Path(tempfile.mkdtemp(prefix="fuzzing-"))
    folder.mkdir(parents=True, exist_ok=True)
    if given.number is not None:
        return _again(names[0], given.seed, given.number, folder)
    outcomes = fuzz(shares(given.inputs, names), given.seed, folder, workers=given.workers)
    print(table(outcomes))
    for outcome in outcomes:
        for kind, numbers in outcome.kinds().items():
            print(f"{outcome.reader}: {len(numbers)} × {kind}; inputs {', '.join(map(str, numbers[:5]))}")
    return 1 if any(outcome.findings for outcome in outcomes) else 0


def table(outcomes: list[Outcome]) -> str:
    """Return a line for each reader, and one for all."""
    lines = [f"{'reader':<24}{'inputs':>8}{'refused':>9}{'seconds':>9}{'longest':>9}{'memory':>9}{'findings':>10}"]
    whole = Outcome("all")
    for outcome in outcomes:
        whole.inputs, whole.refused = whole.inputs + outcome.inputs, whole.refused + outcome.refused
        whole.seconds += outcome.seconds
        whole.longest, whole.memory = max(whole.longest, outcome.longest), max(whole.memory, outcome.memory)
        whole.findings += outcome.findings
    lines += [
        f"{each.reader:<24}{each.inputs:>8}{each.refused:>9}{each.seconds:>8.1f}s{each.longest:>8.2f}s"
        f"{each.memory / 1e3:>7.0f}MB{len(each.findings):>10}"
        for each in [*outcomes, whole]
    ]
    return "\n".join(lines)


def _again(name: str, seed: int, number: int, folder: Path) -> int:
    (folder / "progress").write_bytes(bytes(PROGRESS.size))
    watch = Watch(name, seed, folder)
    watch.prepare(number)
    print(f"the input is in {folder / 'work'}")
    READERS[name].use(folder / "work")
    return 0


if __name__ == "__main__":
    sys.exit(main())
