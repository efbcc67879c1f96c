"""Help that starts with examples, at once, and a README that says the same.

Run as a script it writes the README's command section anew.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from hdmap_tools.cli.main import _COMMANDS, hdmap

README = Path(__file__).resolve().parents[2] / "README.md"
SECTION = re.compile(r"(<!-- generated: commands[^>]*-->\n)(.*?)(<!-- end -->)", re.DOTALL)


def pages() -> list[tuple[str, ...]]:
    return [
        *((name,) for name in _COMMANDS),
        *(("plugins", name) for name in ("list", "info", "check")),
    ]


def help_of(*command: str) -> str:
    result = CliRunner().invoke(hdmap, [*command, "--help"], prog_name="hdmap", terminal_width=100)
    assert result.exit_code == 0
    return result.output


def command_section() -> str:
    lines = ["```text", help_of().strip(), "```", ""]
    for name in _COMMANDS:
        lines += [f"**`hdmap {name}`**", "", "```text", help_of(name).strip(), "```", ""]
    return "\n".join(lines)


@pytest.mark.parametrize("command", pages(), ids=" ".join)
def test_each_page_starts_with_two_examples_that_can_be_copied(command):
    text = help_of(*command)
    head = text.split("Options:")[0]
    examples = re.findall(r"^    (hdmap .*)$", head, re.MULTILINE)
    assert len(examples) >= 2, text
    for example in examples:
        assert example.split()[1] in _COMMANDS


def test_the_summaries_in_the_list_are_those_of_the_commands():
    for name, summary in _COMMANDS.items():
        assert help_of(name).splitlines()[2].strip() == summary


def test_the_readme_shows_the_help_as_it_is():
    found = SECTION.search(README.read_text(encoding="utf-8"))
    assert found, "README.md has no generated command section"
    assert found[2] == command_section() + "\n", "run: python tests/cli/test_help.py"


def test_help_is_there_at_once():
    # Processor time, not wall time: other tests may keep the machine busy.
    before = os.times()
    subprocess.run(
        [sys.executable, "-c", "from hdmap_tools.cli.main import main; main(['--help'])"],
        check=True,
        capture_output=True,
    )
    after = os.times()
    seconds = sum(after[2:4]) - sum(before[2:4])
    assert seconds < 0.4


def test_help_imports_nothing_heavy():
    code = (
        "import sys\nfrom hdmap_tools.cli.main import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print([m for m in ('numpy', 'shapely', 'pydantic', 'zarr', 'cv2') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_an_unknown_command_is_wrong_usage():
    result = CliRunner().invoke(hdmap, ["rum"])
    assert result.exit_code == 2
    assert "rum" in result.output


if __name__ == "__main__":
    text = README.read_text(encoding="utf-8")
    README.write_text(
        SECTION.sub(lambda m: m[1] + command_section() + "\n" + m[3], text), encoding="utf-8"
    )
