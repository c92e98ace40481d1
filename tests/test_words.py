"""Documentation and docstrings are free of phrases that readers had to read twice."""

import io
import json
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# A pattern, and what to write instead.
PHRASES = {
    r"none that others make up for": "no parameter can be replaced by others",
    r"say nothing of (motions|what)": "is valid for the recorded motions only",
    r"who is killed|goes on where it was": "a killed run can continue",
    r"through the same door|[Tt]he one door": "is a method of",
    r"next to nothing": "almost nothing",
    r"so many \w+ more\b": "additional",
    r"eat the physics": "absorb a missing effect",
    r"not to be told (apart|from)": "indistinguishable",
    r"sinks? into noise": "falls below the noise",
    r"[Nn]obody knows": "is not known",
    r"that matter can have": "physically consistent",
    r"\bcame out right\b|\bcome out alike\b": "is right, agree",
    r"a number is none": "a number is NaN",
    r"lets? it show": "becomes visible",
    r"\bfor good\b": "permanently",
    r"\b(file|row|column|one) a (joint|recording|sample)\b": "for each",
    r"what there is (so far|to)": "the result so far",
    r"\bis worth asking\b|worth asking about": "to screen",
    r"wrong valley|finds? back\b": "wrong minimum, converges",
    r"\bruns? away\b": "diverges",
    r"\bgives? way\b": "is compliant",
    r"\bmakes? up for\b": "absorbs",
    r"\btold apart\b|\btells? (it|them) apart\b": "distinguished",
    r"\bcannot (be told|tell it) from\b": "cannot distinguish",
    r"\bholds? no\b": "contains no",
    r"\b(goes|going|go) on from\b": "continues",
    r"\bno fit (has seen|saw)\b": "held out",
    r"\bmend (it|that|them)\b": "correct",
    r"\b[Mm]easured less\b|\bfirst less second\b": "minus",
    r"\b(counts|filter|samples|series|steps|task|turns) an? (core|output|second|turn)\b": "per",
    r"\bgoes round\b": "is fed back",
    r"\bjudged on\b": "tested on",
    r"\blooks? as if\b": "seems",
    r"\b[Nn]one where\b|\*\*Raises:\*\* `\w+` where\b": "if",
    r"\bshared? out\b": "distributed",
    r"\bnext to none\b": "almost none",
    r"\bhonest\b|\bhonesty\b": "correct",
    r"\bis no (kp|TOML|table|solver|share|sampl)": "is not a",
    r"\bat hand\b": "present",
    r"\bpart company\b|\bcomes? apart\b": "differ, can be distinguished",
    r"\bworth asking\b|\bto be asked\b": "to screen",
    r"\bsays? nothing\b|\bsay something\b": "has no information",
    r"\bwhat (there )?is there\b": "the existing",
    r"\bheld against\b": "compared with",
    r"\bworth knowing\b": "relevant",
    r"\b(is|are) worth trying\b|\bvalues worth trying\b": "to try",
    r"\bas (was )?(told|asked)\b": "at the limit",
    r"\b(takes?|took|taken) for noise\b": "models as noise",
    r"\bare parted\b|\bpart drive and link\b": "are separated by a transmission",
    r"\b(a joint|it|the model) leaves \{": "the error of ... is",
    r"\bat the most\b": "largest number of",
    r"\bone an? (output|joint|recording)\b": "one per",
}


def pages() -> dict[str, str]:
    """The text of every page, and of the notebooks' cells that are no code."""
    found = {p.name: p.read_text("utf-8") for p in sorted(ROOT.glob("docs/**/*.md"))}
    found |= {name: (ROOT / name).read_text("utf-8") for name in ("README.md", "CHANGELOG.md")}
    for notebook in sorted(ROOT.glob("notebooks/*.ipynb")):
        cells = json.loads(notebook.read_text("utf-8"))["cells"]
        prose = ["".join(c["source"]) for c in cells if c["cell_type"] == "markdown"]
        found[notebook.name] = "\n".join(prose)
    return found


def spoken(source: str) -> str:
    """Comments and strings of a module, one after the other."""
    kinds = tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", -1)
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return "\n".join(token.string for token in tokens if token.type in kinds)


def modules() -> dict[str, str]:
    """Comments and strings of the modules."""
    package = ROOT / "jaxid"
    paths = [p.relative_to(package) for p in sorted(package.rglob("*.py"))]
    return {str(p): spoken((package / p).read_text("utf-8")) for p in paths}


def benchmarks() -> dict[str, str]:
    """Docstrings and comments of the benchmarks, in a checkout that has them."""
    paths = sorted((ROOT / "benchmarks").glob("*.py"))
    return {p.name: spoken(p.read_text("utf-8")) for p in paths}


def found_in(texts: dict[str, str]) -> list[str]:
    """Places and phrases; line breaks count as blanks, as a reader takes them."""
    flat = {name: re.sub(r"[\s#]+", " ", text) for name, text in texts.items()}
    return [
        f"{name}: {hit.group(0)!r}, write: {better}"
        for name, text in flat.items()
        for pattern, better in PHRASES.items()
        for hit in re.finditer(pattern, text)
    ]


@pytest.mark.parametrize("texts", [pages, modules, benchmarks])
def test_no_phrase_that_must_be_read_twice(texts) -> None:
    given = texts()
    assert len(given) > 15 or texts is benchmarks
    assert not found_in(given)


def test_the_check_finds_a_phrase_across_lines_and_in_comments() -> None:
    assert found_in({"page": "what is\nnext to\nnothing"})
    module = spoken("# those who\n# held against the\n# residual\nx = f'{1} for good'\n")
    assert len(found_in({"module": module})) == 2
