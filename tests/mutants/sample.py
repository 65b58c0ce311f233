"""Draw mutants of modules by a seed, and count those that tests kill (``make mutants-sample``).

    python tests/mutants/sample.py --output mutants.json [--seed 0] [--count 9] [--resume] [FILE …]

The changes are those of mutmut; ``selection.json`` has the tests of each module.
"""

import argparse
import difflib
import json
import random
import sys
from pathlib import Path

import libcst
from apply import run
from libcst.metadata import MetadataWrapper
from mutmut.mutation.file_mutation import MutationVisitor, deep_replace
from mutmut.mutation.mutators import mutation_operators
from mutmut.mutation.pragma_handling import IgnoredCode
from mutmut.mutation.trampoline_templates import mangle_function_name

SELECTION = Path(__file__).with_name("selection.json")


def draw(code: str, count: int, seed: int) -> dict[str, str]:
    """Draw mutants of a module's code: the changed code by mutmut's name of the mutant."""
    visitor = MutationVisitor(mutation_operators, IgnoredCode(set(), set(), set()))
    module = MetadataWrapper(libcst.parse_module(code)).visit(visitor)
    nodes = {}
    for node in module.body:
        owner = node.name.value if isinstance(node, libcst.ClassDef) else None
        for child in node.body.body if isinstance(node, libcst.ClassDef) else [node]:
            if isinstance(child, libcst.FunctionDef):
                name = mangle_function_name(name=child.name.value, class_name=owner)
                own = (m for m in visitor.mutations if m.contained_by_top_level_function is child)
                for number, mutation in enumerate(own, start=1):
                    place = mutation.original_node, mutation.mutated_node
                    nodes[f"{name}__mutmut_{number}"] = place
    order = sorted(nodes)
    random.Random(seed).shuffle(order)  # a smaller count draws the first of a larger one's
    return {name: deep_replace(module, *nodes[name]).code for name in order[:count]}


def killer(code: int, output: str) -> str:
    """Return the first failure of the tests of a mutant, if any."""
    failures = [row for row in output.splitlines() if row.startswith(("FAILED", "ERROR"))]
    return "" if code == 0 else (failures or [f"exit {code}"])[0]


def main() -> None:
    """Check the mutants and print the share that is killed, and the survivors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=300, help="mutants of all modules together")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--resume", action="store_true", help="skip mutants in the output")
    parser.add_argument("modules", nargs="*", help="by default all of selection.json")
    args = parser.parse_args()
    selection = json.loads(SELECTION.read_text())
    selection = {name: selection[name] for name in args.modules or selection}
    resumed = args.resume and args.output.exists()
    results = json.loads(args.output.read_text()) if resumed else {}
    whole = [((name, ""), name, Path(name).read_text(), tests) for name, tests in selection.items()]
    for (module, _), code, output, _ in run(whole):
        if code:
            sys.exit(f"error: the tests of {module} fail without a mutant: {killer(code, output)}")
    for module, tests in selection.items():
        text, result = Path(module).read_text(), results.setdefault(module, {})
        mutants = draw(text, args.count // len(selection), args.seed)
        jobs = [(n, module, code, tests) for n, code in mutants.items() if n not in result]
        for name, code, output, _ in run(jobs):
            change = difflib.unified_diff(text.splitlines(), mutants[name].splitlines(), n=1)
            result[name] = {"killer": killer(code, output), "diff": "\n".join(change)}
            args.output.write_text(json.dumps(results, indent=1))
        alive = {name: entry["diff"] for name, entry in result.items() if not entry["killer"]}
        print(f"{module}: {len(result) - len(alive)} of {len(result)} killed", flush=True)
        print("\n".join(alive.values()))


if __name__ == "__main__":
    main()
