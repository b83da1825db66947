#!/usr/bin/env python3
"""Checks comments and documentation: columns, private words, names of constants, first lines of functions.

python3 scripts/check_words.py [PATH ...]    the given files and folders, or those in CHECKED
python3 scripts/check_words.py --all         every file under version control
"""

import re
import subprocess
import sys
from pathlib import Path

CHECKED = "README.md CHANGELOG.md docs fuzz/README.md tests scripts crates".split()
# Printed by `qudi config docs` from comments in the sources, or naming the banned phrases.
SKIPPED = {"docs/settings.md", "scripts/check_words.py"}
COLUMNS = 110
# Words that only this project used in this sense, and their replacements.
BANNED = {
    r"(?<!so )(?<!such )\b(that|those) of\b": "repeat the noun",
    r"\bof (then|today)\b": "name the version or the commit",
    r"\b(a|the|no|with) ways? out\b": "remedy, or what to do",
    r"\b(come|comes|came|coming) along\b": "bundled",
    r"\b(our|their|paper's) side\b": "name who does it",
    r"\bat rest\b|\b(held|holds?|stands?) still\b": "static",
    r"\b(of|by) looks\b|\blooks of\b": "appearance",
    r"\bbeside\b": "next to, with, or given",
    r"\bwanted\b": "requested, or needed",
    r"\bwho names? none\b": "by default",
    r"\bin the place of\b": "instead of",
    r"\bcomes? to rest\b": "no longer changes",
    r"\bwhat is unknown\b": "the remaining error",
}
# Names of constants without a noun.
NOUNLESS = set(
    """AHEAD APART ASKED BEST BRIGHTER BRIGHTEST COARSER COARSEST CUSTOMARY DEEPEST ENOUGH FARTHEST FASTEST FEW FEWEST
    FINE FORCED FOUND FULL KEEP KEPT KNOWN LARGEST LEAST LEFT LONGEST LOOKED_AT LOOKS MANY MATCHED MAY_CHANGE MOST NEAREST
    NEEDED OPENED PINNED QUICK REACH REDRAWN RELUCTANCE REMOVED SAME SATURATED SHORTEST SHOWN SMALLEST STIFF SURE TOLERATED
    TRIMMED TURNED WIDE WORSE WORST ZERO_AT_FIRST""".split()
)
COMMENT = {".rs": r"\s*//[/!]?( |$)", ".py": r"\s*#", ".sh": r"\s*#", ".toml": r"\s*#", ".md": r"(?!\s*```)"}
CONSTANT = re.compile(r"\b(?:const|static) (?:mut )?([A-Z][A-Z0-9_]*)\s*:")
FUNCTION = re.compile(r"\s*(pub(\([^)]*\))? )?((const|async|unsafe) )*fn \w")
NO_VERB = re.compile(r"\s*/// (The|What|Whether|How|Where|An?) ")


def prose(lines, suffix):
    """Returns the text of every comment line, or of Markdown outside code blocks; None for other lines."""
    texts, fenced = [], False
    for line in lines:
        fenced ^= suffix == ".md" and line.lstrip().startswith("```")
        match = None if fenced else re.match(COMMENT[suffix], line)
        texts.append(line[match.end() :] if match else None)
    return texts


def findings(lines, suffix):
    """Yields numbers of lines with what is wrong; a phrase may run on into the next line."""
    texts = [*prose(lines, suffix), None]
    for n, line in enumerate(lines):
        if (text := texts[n]) is not None:
            if len(line) > COLUMNS and not re.search(r"^\s*\||\]\(|://", line):
                yield n, f"{len(line)} columns, at most {COLUMNS}"
            joined = f"{text} {(texts[n + 1] or '').strip()}"
            for pattern, instead in BANNED.items():
                if (match := re.search(pattern, joined)) and match.start() < len(text):
                    yield n, f"`{match.group()}`: {instead}"
        if suffix == ".rs" and (match := CONSTANT.search(line)) and match.group(1) in NOUNLESS:
            yield n, f"constant `{match.group(1)}` has no noun"
        if suffix == ".rs" and NO_VERB.match(line) and not lines[n - 1].lstrip().startswith("///"):
            head = iter(lines[n + 1 :])
            item = next((text for text in head if not re.match(r"\s*(///|#\[(?!test)|\)\]|$)", text)), "")
            if FUNCTION.match(item):  # A test's comment may state what holds.
                yield n, f"`{line.split()[1]} ...`: the first line of a function begins with a verb"


paths = [] if "--all" in sys.argv else sys.argv[1:] or CHECKED
listed = subprocess.run(["git", "ls-files", "--", *paths], capture_output=True, text=True, check=True).stdout
failed = False
for path in map(Path, listed.splitlines()):
    if path.suffix in COMMENT and path.exists() and str(path) not in SKIPPED:
        for n, what in findings(path.read_text().splitlines(), path.suffix):
            failed = True
            print(f"{path}:{n + 1}: {what}")
sys.exit(failed)
