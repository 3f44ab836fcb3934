"""Run the first half of the README, as somebody does who has installed `lagros[bench]` and no more.

    python tests/first_half.py README.md

in an empty folder, with the environment's programs first on the path: its Python from block to
block, then what it says to type, up to the heading `TRAINING`. Nothing but the standard library is
imported here.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))

from tests import documents

TRAINING = "\n## From nothing\n"
# What makes the environment is done already.
INSTALLS = ("make", "pip", "source")


def blocks_and_commands(text: str) -> tuple[list[str], list[documents.Command]]:
    """Return the Python and the commands of a README's first half."""
    first, heading, _ = text.partition(TRAINING)
    if not heading:
        raise ValueError(f"there is no heading {TRAINING.strip()!r}")
    typed = [command for command in documents.commands(first) if command.words[0] not in INSTALLS]
    return documents.python_blocks(first), typed


def write_modules(text: str, folder: Path = Path()) -> None:
    """Write the modules that a page asks for: Write `mine.py`: and the next block."""
    asked = r"Write\s+`(\w+\.py)`:\s+```python\n(.*?)^```"
    for name, block in re.findall(asked, text, re.MULTILINE | re.DOTALL):
        (folder / name).write_text(block, encoding="utf-8")


def main(readme: Path) -> None:
    """Run all of it; the first thing that fails ends it."""
    text = readme.read_text(encoding="utf-8")
    blocks, typed = blocks_and_commands(text)
    write_modules(text)
    Path("blocks.py").write_text("\n\n".join(blocks), encoding="utf-8")
    for words in [("python", "blocks.py"), *(command.words for command in typed)]:
        print("$", *words, flush=True)
        begun = time.perf_counter()
        subprocess.run(words, check=True, stdin=subprocess.DEVNULL)
        print(f"  {time.perf_counter() - begun:.1f} s", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
