import subprocess
import sys
import time
import warnings
from dataclasses import fields
from importlib import import_module

import pytest
import tyro

from concent_warp.cli import entry, main
from concent_warp.cli.entry import COMMANDS, EXAMPLES
from concent_warp.cli.help_text import ALL, main_help
from concent_warp.cli.option_names import options_of

HEAVY = ("numpy", "mujoco", "warp", "torch", "matplotlib", "rich", "tyro", "trimesh", "scipy")


def python(*arguments):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=60)


def test_help_lists_every_command_in_under_a_second():
    start = time.perf_counter()
    done = python("-m", "concent_warp", "--help")
    assert time.perf_counter() - start < 1.0
    assert done.returncode == 0
    assert all(f"  {name} " in done.stdout for name in COMMANDS)


@pytest.mark.parametrize("code", ["import concent_warp", "from concent_warp.cli import main; main(['--help'])"])
def test_nothing_heavy_is_imported_before_it_is_needed(code):
    done = python("-c", f"import sys; {code}; print(*[n for n in {HEAVY} if n in sys.modules], file=sys.stderr)")
    assert done.stderr.split() == []


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_its_options(command, capsys):
    assert main([command, "--help"]) == 0
    assert f"usage: concent {command}" in capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_the_main_options_and_help_all_the_advanced_ones_as_well(command, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    texts = []
    for option in ("--help", ALL):
        assert main([command, option]) == 0
        texts.append(capsys.readouterr().out)
        assert max(len(line) for line in texts[-1].splitlines() if not line.startswith("Example: ")) <= 80
    names = {option for _, option in options_of(import_module(module_name(command)).Arguments) if option[0] == "-"}
    assert all(name in texts[1] for name in names)
    advanced = {name for name in names if "." in name and not name.startswith("--robot.")}
    assert not any(f"\n│ {name} " in texts[0] or f"\n  {name} " in texts[0] for name in advanced)
    assert ("advanced settings, shown by" in texts[0]) == bool(advanced or command == "geometry")
    assert len(texts[0].splitlines()) < 80
    assert "advanced settings, shown by" not in texts[1]


def test_help_without_frames_is_cut_as_well():
    text = "usage\n\n options   \n -------\n  --a INT\n\n fit.b options  \n -------\n  --fit.b.c INT\n"
    shown = text[: text.index(" fit.b")]
    assert main_help(text, "fit") == f"{shown}\nadvanced settings, shown by concent fit --help-all:\n  fit.b\n"
    assert main_help(shown, "fit") == shown


def module_name(command):
    return f"concent_warp.cli.commands.{command.replace('-', '_')}"


def test_no_arguments_show_the_help_and_version_the_version(capsys):
    assert main([]) == 0
    assert "usage: concent" in capsys.readouterr().out
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("concent 0.")


def test_a_warning_is_one_line_without_a_place_in_the_code(monkeypatch, capsys):
    def warn(*command):
        warnings.warn(f"{command[0]}: contacts\nwere dropped", stacklevel=1)
        return 0

    monkeypatch.setattr(entry, "_run", warn)
    before = warnings.formatwarning
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = lambda *a: sys.stderr.write(warnings.formatwarning(*a[:4]))
        assert main(["fit"]) == 0
    assert capsys.readouterr().err == "concent fit: warning: fit: contacts were dropped\n"
    assert warnings.formatwarning is before


def test_an_unknown_command_is_named_with_the_known_ones(capsys):
    assert main(["graund"]) == 2
    error = capsys.readouterr().err
    assert "'graund'" in error
    assert "demo" in error


def test_an_unknown_option_ends_with_code_2(bench, capsys):
    assert main(["compare", str(bench / "demo.h5"), "--modle", "x"]) == 2
    assert "--model" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["compare", "nowhere.h5", "--model", "m.toml"], "no such recording"),
        (["fit", "demo.h5", "--model", "nowhere.toml", "--out", "run"], "no such model"),
        (["fit", "demo.h5", "--demonstrations", "demo_9", "--out", "run"], "no such demonstration"),
        (["fit", "demo.h5", "--scene", "nowhere.xml", "--out", "run"], "no such MJCF"),
        (["replay", "demo.h5", "--model", "demo.h5"], "not a TOML"),
        (
            ["events", "demo.h5", "--model", "inset.toml", "--staging.min-touch-share", "3"],
            "--staging.min-touch-share is",
        ),
        (["geometry", "demo.h5"], "nothing to write"),
        (["geometry", "demo.h5", "--out", "x.toml", "--count", "1"], "too few spheres"),
        (["record", "--out", "new/r.h5", "--robot", "nowhere.xml"], "no such robot"),
    ],
)
def test_what_is_wrong_is_reported_in_one_sentence_and_nothing_is_left_behind(
    arguments, words, bench, tmp_path, monkeypatch, capsys
):
    for path in bench.iterdir():
        if path.is_file():
            (tmp_path / path.name).symlink_to(path)
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert words in err
    assert "Traceback" not in out + err
    assert sorted(tmp_path.rglob("*")) == before


def test_errors_of_the_library_are_one_line(bench, capsys):
    main(["compare", "nowhere.h5", "--model", str(bench / "inset.toml")])
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("concent compare: nowhere.h5: ")
    assert lines[0].endswith(".")


def test_a_reader_that_closes_the_pipe_causes_no_traceback():
    script = f"{sys.executable} -m concent_warp fit --help | head -n 1"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert done.stdout.startswith("usage")
    assert done.stderr == ""


def test_a_place_that_cannot_be_written_is_reported_in_one_sentence(bench, capsys):
    assert main(["geometry", str(bench / "demo.h5"), "--out", "/proc/nowhere/model.toml"]) == 2
    error = capsys.readouterr().err
    assert "/proc/nowhere" in error
    assert error.count("\n") == 1


def test_a_command_that_takes_long_to_start_says_that_it_is_loading():
    slow = "import time, concent_warp.cli.entry as e; e.LOADING_AFTER = 0.05; e.import_module = lambda _: time.sleep(1)"
    done = python("-c", f"{slow}\ntry: e.main(['fit', 'demo.h5'])\nexcept AttributeError: pass")
    assert done.stderr.startswith("concent fit: loading ...\n")


def test_the_help_names_an_example_of_the_command(capsys):
    assert main(["compare", "--help"]) == 0
    assert "Example: concent compare demo.h5" in capsys.readouterr().out


def test_every_example_of_a_command_is_parsed():
    for command, line in EXAMPLES.items():
        _, name, *arguments = line.split()
        assert name == command
        module = import_module(f"concent_warp.cli.commands.{command.replace('-', '_')}")
        tyro.cli(module.Arguments, args=arguments)


@pytest.mark.parametrize("command", [name for name in COMMANDS if name not in ("play", "evaluate")])
def test_what_is_written_is_named_by_out_or_its_short_form(command):
    module = import_module(f"concent_warp.cli.commands.{command.replace('-', '_')}")
    writes = "out" in {field.name for field in fields(module.Arguments)}
    assert writes or {"html", "png"} & {field.name for field in fields(module.Arguments)}
    if writes:
        assert "-o" in tyro.extras.get_parser(module.Arguments).format_help()
