"""Mutation tests: which damage to the code do the tests notice?

Cosmic Ray makes the mutants and runs ``mutants.py test`` on each. Three commands of this file surround it:

- ``mutants.py sample SESSION COUNT`` keeps a random sample of the mutants of each package and skips all others. What
  cannot change results is not drawn: signatures, annotations, messages, ``__repr__``, and options of calls such as
  ``strict``.
- ``mutants.py test`` runs the tests that cover the mutated line, those of its own package first, until one fails. It
  reads which tests these are from the contexts in ``.coverage``.
- ``mutants.py report SESSION ..`` counts the mutants of each package that change results, and those killed, and shows
  survivors. Which change nothing, and why, is in ``equivalent_mutants.py``.
"""

import argparse
import ast
import random
import re
import resource
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

PACKAGE = Path("plugin/mitsuba_subdivision")

# Operators that raise an error wherever they are tried, such as a shift of floats, would only flatter the count.
OPERATORS = re.compile(
    r"core/(ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Mul_Add|Div_Mul|FloorDiv_Mul|Mod_Add|Pow_Mul|LShift_RShift"
    r"|RShift_LShift|BitOr_BitAnd|BitAnd_BitOr|BitXor_BitOr)"
    r"|ReplaceComparisonOperator_(Eq_NotEq|NotEq_Eq|Lt_LtE|LtE_Lt|Gt_GtE|GtE_Gt|Lt_Gt|Gt_Lt|Is_IsNot|IsNot_Is)"
    r"|ReplaceUnaryOperator_(USub_UAdd|Delete_USub|Delete_Invert|Delete_Not)"
    r"|AddNot|ReplaceTrueWithFalse|ReplaceFalseWithTrue|ReplaceAndWithOr|ReplaceOrWithAnd|ReplaceBreakWithContinue"
    r"|ReplaceContinueWithBreak|NumberReplacer|ZeroIterationForLoop)$"
)

# Tests that one call of pytest gets: so many are quick to collect, and the first ones kill most mutants.
FIRST_TESTS = 40

# Functions whose calls, and conditions whose blocks, leave results as they are.
SILENT = ("warnings.warn", "TYPE_CHECKING")

# Options that check what holds anyway, or choose between equal values: of `zip`, `dataclass` and `astype`.
CHECKS = ("strict", "frozen", "eq", "copy")


def lines_without_results(path: Path) -> set[int]:
    """Lines, from 1, of signatures, of what is raised or warned, of ``__repr__`` and of imports for types."""
    lines: set[int] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        part: ast.AST | None = None
        if isinstance(node, ast.FunctionDef):
            # A default value may stand there; it is left out as well.
            lines.update(range(node.lineno, node.body[0].lineno))
            part = node if node.name == "__repr__" else None
        elif isinstance(node, ast.Raise) or (
            isinstance(node, ast.Call | ast.If)
            and ast.unparse(node.func if isinstance(node, ast.Call) else node.test) in SILENT
        ):
            part = node
        if part is not None:
            lines.update(range(part.lineno, part.end_lineno + 1))
    return lines


def places_without_results(path: Path) -> set[tuple[int, int]]:
    """Line, from 1, and column, from 0, of annotations and of the values of options that leave results as they are."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    parts = [node.annotation for node in nodes if isinstance(node, ast.AnnAssign)]
    parts += [node.value for node in nodes if isinstance(node, ast.keyword) and node.arg in CHECKS]
    return {(part.lineno, column) for part in parts for column in range(part.col_offset, part.end_col_offset)}


def sample(session: str, count: int, seed: int) -> None:
    """Keep ``count`` mutants of each package, at most one on each line, and delete all others from the session."""
    with closing(sqlite3.connect(session)) as database, database:
        mutations = database.execute(
            "SELECT module_path, start_pos_row, start_pos_col, operator_name, occurrence, job_id FROM mutation_specs"
            " ORDER BY 1, 2, 4, 5"
        ).fetchall()
        places: dict[str, dict[tuple[str, int], list[str]]] = {}
        without_results: dict[str, tuple[set[int], set[tuple[int, int]]]] = {}
        for path, line, column, operator, _, job in mutations:
            if path not in without_results:
                without_results[path] = lines_without_results(Path(path)), places_without_results(Path(path))
            lines_without, places_without = without_results[path]
            if OPERATORS.match(operator) and line not in lines_without and (line, column) not in places_without:
                package = Path(path).relative_to(PACKAGE).parts[0]
                places.setdefault(package, {}).setdefault((path, line), []).append(job)
        drawn = set()
        for package, lines in places.items():
            generator = random.Random(f"{seed} {package}")
            drawn.update(
                generator.choice(lines[place]) for place in generator.sample(sorted(lines), min(count, len(lines)))
            )
        others = [(job,) for *_, job in mutations if job not in drawn]
        for table in ("mutation_specs", "work_items"):
            database.executemany(f"DELETE FROM {table} WHERE job_id = ?", others)


def mutated_lines() -> tuple[Path, list[int]]:
    """The module that differs from the commit, and its lines that do."""
    diff = subprocess.run(
        ["git", "diff", "-U0", "--", str(PACKAGE)], capture_output=True, text=True, check=True
    ).stdout  # fmt: skip
    path = re.search(r"^--- a/(.*)$", diff, re.MULTILINE)
    if path is None:
        raise SystemExit(f"{PACKAGE} has no mutant: it is as committed")
    lines = [int(line) for line in re.findall(r"^@@ -(\d+)", diff, re.MULTILINE)]
    return Path(path[1]), lines


def lines_of_functions(path: Path) -> set[int]:
    """Lines, from 1, that run when a function is called."""
    functions = (
        node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.FunctionDef)
    )
    return {line for node in functions for line in range(node.body[0].lineno, node.end_lineno + 1)}


def covering_tests(path: Path, lines: list[int]) -> list[str]:
    """Tests that run any of the lines: of the module's package first, and of each test function one case first."""
    from coverage import CoverageData

    data = CoverageData()
    data.read()
    measured = next((file for file in data.measured_files() if file.endswith(str(path))), "")
    contexts = data.contexts_by_lineno(measured) if measured else {}
    if not lines_of_functions(path).issuperset(lines):
        # What runs at import, in whichever test that is, takes part wherever the module does.
        lines = list(contexts)
    tests = {context.partition("|")[0] for line in lines for context in contexts.get(line, ()) if context}
    own = f"tests/{path.relative_to(PACKAGE).parts[0]}/"
    cases: dict[str, int] = {}
    ranked = []
    for test in sorted(tests):
        function = test.partition("[")[0]
        cases[function] = cases.get(function, -1) + 1
        ranked.append((cases[function], not test.startswith(own), test))
    # Where no test covers the line, as at import, the package's own tests run.
    return [test for _, _, test in sorted(ranked)] or [own]


def run_tests(memory: int) -> int:
    """Run the tests that cover the mutant, in so many GB, as some mutants allocate without end; 0 if all pass."""
    import pytest

    resource.setrlimit(resource.RLIMIT_DATA, (memory << 30, memory << 30))
    tests = covering_tests(*mutated_lines())
    options = ["-x", "-q", "--no-header", "--no-summary", "-p", "no:cacheprovider", "-p", "no:xdist"]
    return pytest.main([*options, *tests[:FIRST_TESTS]]) or (
        pytest.main([*options, *tests[FIRST_TESTS:]]) if tests[FIRST_TESTS:] else 0
    )


def report(sessions: list[str]) -> None:
    """Print counts of each package, and the survivors that are not known to be equivalent."""
    from equivalent_mutants import EQUIVALENT

    known = {
        (module, " ".join(was.split()), " ".join(now.split())) for _, rows in EQUIVALENT for module, was, now in rows
    }
    counts: dict[str, dict[str, int]] = {}
    for session in sessions:
        with closing(sqlite3.connect(f"file:{session}?mode=ro", uri=True)) as database:
            results = database.execute(
                "SELECT module_path, test_outcome, diff FROM work_items LEFT JOIN mutation_specs USING (job_id)"
                " LEFT JOIN work_results USING (job_id)"
            ).fetchall()
        for path, outcome, diff in results:
            module = Path(path).relative_to(PACKAGE)
            was, now = (
                " ".join(" ".join(re.findall(rf"^\{sign}(?!\{sign})(.*)$", diff or "", re.MULTILINE)).split())
                for sign in "-+"
            )
            kind = "not run" if outcome is None else outcome.lower()
            if kind == "survived":
                kind = "equivalent" if (str(module), was, now) in known else "open"
            for name in (module.parts[0], "all"):
                row = counts.setdefault(name, dict.fromkeys(("killed", "equivalent", "open", "not run"), 0))
                row[kind] += 1
            if kind == "open":
                print(f"{module}\n- {was}\n+ {now}\n")
    for name, row in sorted(counts.items()):
        judged = row["killed"] + row["open"]
        part = f"{100 * row['killed'] / judged:.0f} % killed" if judged else ""
        print(f"{name:13}", *(f"{count} {kind}," for kind, count in row.items()), part)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    sampling = commands.add_parser("sample", help="keep a sample of a session's mutants")
    sampling.add_argument("session")
    sampling.add_argument("count", type=int, help="mutants of each package")
    sampling.add_argument("--seed", type=int, default=0)
    testing = commands.add_parser("test", help="run the tests that cover the mutated line")
    testing.add_argument("--memory", type=int, default=6, help="most memory, in GB")
    reporting = commands.add_parser("report", help="count mutants and show survivors")
    reporting.add_argument("sessions", nargs="+")
    given = parser.parse_args()
    if given.command == "sample":
        sample(given.session, given.count, given.seed)
    elif given.command == "report":
        report(given.sessions)
    else:
        sys.exit(run_tests(given.memory))
