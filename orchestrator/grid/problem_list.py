"""The mistakes of one grid file, each with its line; a mistake on several tasks is one."""

from __future__ import annotations

from collections.abc import Sequence

from recrl.orchestrator.located_yaml import Document, Problem, YamlPath

TASK_MARK = "\0"  # stands for a task in a sentence, after "on" or "of"


class ProblemList:
    """Mistakes in the order in which they were found."""

    def __init__(self, document: Document) -> None:
        """Begin with the mistakes of YAML syntax.

        Args:
            document: it has the lines of all places.
        """
        self._document = document
        self._problems = list(document.problems)
        self._of_tasks: dict[tuple[YamlPath, str], list[str]] = {}  # tasks with the same mistake

    def __len__(self) -> int:
        """Return the number of mistakes."""
        return len(self._problems)

    def add(self, place: YamlPath, sentence: str) -> None:
        """Add a mistake, with the line of its place."""
        self._problems.append(self._problem(place, sentence))

    def add_of_task(self, place: YamlPath, sentence: str, task: str) -> None:
        """Add a mistake on a task; the same mistake on further tasks stays one, which names them.

        Args:
            place: of the mistake.
            sentence: with ``TASK_MARK`` in place of the task, after a preposition.
            task: its label.
        """
        tasks = self._of_tasks.setdefault((place, sentence), [])
        if tasks:
            self._problems.remove(self._problem(place, _of_tasks(sentence, tasks)))
        tasks.append(task)
        self.add(place, _of_tasks(sentence, tasks))

    def located(self, source: str) -> list[str]:
        """Return one sentence for each mistake, ordered by line.

        Args:
            source: the file's name.
        """
        unique = dict.fromkeys(self._problems)
        ordered = sorted(unique, key=lambda problem: (problem.line, str(problem.place)))
        return [f"{source}:{problem}" for problem in ordered]

    def _problem(self, place: YamlPath, sentence: str) -> Problem:
        return Problem(self._document.line(place), place, sentence)


def _of_tasks(sentence: str, tasks: Sequence[str]) -> str:
    """Return the sentence of a mistake with its task, or with several in brackets at the end.

    >>> _of_tasks(f"mine cannot be built on {TASK_MARK}: no", ["a"])
    'mine cannot be built on a: no'
    >>> _of_tasks(f"mine cannot be built on {TASK_MARK}: no", ["a", "b"])
    'mine cannot be built: no (on a, b)'
    """
    before, after = sentence.split(TASK_MARK, 1)
    if len(tasks) == 1:
        return f"{before}{tasks[0]}{after}"
    head = before.removesuffix(" on ").removesuffix(" of ")
    return f"{head}{after} (on {', '.join(tasks)})"
