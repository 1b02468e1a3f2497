"""No file is read in a way that can run code: pickles, marshalled code, evaluated text."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FILES = [path for top in ("concent_warp", "kernels", "train", "render") for path in sorted((ROOT / top).rglob("*.py"))]
SAFE = {"torch.load": ("weights_only", True), "np.load": ("allow_pickle", False), "numpy.load": ("allow_pickle", False)}
"""Functions that read files, with the argument that keeps them from running what is in them."""
FORBIDDEN = {
    "pickle.load", "pickle.loads", "pickle.Unpickler", "joblib.load", "marshal.load", "marshal.loads", "shelve.open",
    "torch.hub.load", "torch.jit.load", "torch.package.PackageImporter", "yaml.load", "eval", "exec", "compile",
    "dill.load", "cloudpickle.load", "pandas.read_pickle", "runpy.run_path",
}  # fmt: skip


def unsafe(source: str) -> list[str]:
    """Return the calls in a source that could run code from a file."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        given = {word.arg: word.value for word in node.keywords}
        if name in FORBIDDEN:
            found.append(name)
        elif name in SAFE:
            argument, value = SAFE[name]
            stated = given.get(argument)
            if not (isinstance(stated, ast.Constant) and stated.value is value):
                found.append(f"{name} without {argument}={value}")
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_is_read_that_could_run_code(path):
    assert unsafe(path.read_text()) == []


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("torch.load(path)", ["torch.load without weights_only=True"]),
        ("torch.load(path, weights_only=False)", ["torch.load without weights_only=True"]),
        ("torch.load(path, weights_only=True)", []),
        ("np.load(path, allow_pickle=flag)", ["np.load without allow_pickle=False"]),
        ("np.load(path, allow_pickle=False)", []),
        ("import pickle\npickle.loads(data)", ["pickle.loads"]),
        ("eval(text)", ["eval"]),
        ("model.eval()", []),
    ],
)
def test_what_could_run_code_is_found(source, names):
    assert unsafe(source) == names
