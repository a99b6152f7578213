"""The API reference: a page for each part of the package, made from its docstrings."""

import importlib
import re
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import hqp_grasp

PARTS = {
    "grasp": "What was felt",
    "tasks": "Tasks",
    "hierarchy": "Hierarchy",
    "control": "Control",
    "world": "World",
    "touch": "Touch",
    "judge": "Judge",
    "experiments": "Experiments",
    "errors": "Errors",
}
BELONGS = {"history": "grasp"}  # other modules at the top of the package
BESIDE = "  # "
VALUES = {"GRIP_LAWS": "The laws that a `Grip` and a `Hold` press by, unless told otherwise."}
STAR = re.compile(r"(?<=\w)\*(?=\w|\s*[=+)])")  # in J*J, unlike that of *emphasis*


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> None:
    """MkDocs calls this with the pages that are there; all that is exported gets a place."""
    names: dict[str, list[str]] = {part: [] for part in PARTS}
    for name in hqp_grasp.__all__:
        part = getattr(hqp_grasp, name).__module__.split(".")[1]
        names[BELONGS.get(part, part)].append(name)
    overview = ["# Reference", "All that `import hqp_grasp as hg` brings, by topic, a line each."]
    for part, title in PARTS.items():
        about = (importlib.import_module(f"hqp_grasp.{part}").__doc__ or "").splitlines()[0]
        listed = [f"- [`{n}`]({part}.md#hqp_grasp.{n}): {line(n)}" for n in names[part]]
        overview += [f"## [{title}]({part}.md)", about, "\n".join(listed)]
        page = [f"# {title}", about, *(f"::: hqp_grasp.{name}" for name in names[part])]
        files.append(_page(config, part, page))
    files.append(_page(config, "index", overview))


def line(name: str) -> str:
    """What an exported name is, in the words that its docstring begins with."""
    if name in VALUES:
        return VALUES[name]
    return STAR.sub(r"\*", (getattr(hqp_grasp, name).__doc__ or "").strip().splitlines()[0])


def _page(config: MkDocsConfig, name: str, paragraphs: list[str]) -> File:
    return File.generated(config, f"reference/{name}.md", content="\n\n".join(paragraphs))


class Fields(griffe.Extension):
    """Docstrings as Markdown, and below them what stands beside a field in the source."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """griffe calls this with everything that it has read."""
        if obj.docstring:
            obj.docstring.value = STAR.sub(r"\*", obj.docstring.value)

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:
        """griffe calls this with every class, once its members are there."""
        fields = []
        for name, member in cls.members.items():
            if "property" not in member.labels and member.is_attribute and name[0] != "_":
                _, _, meaning = member.lines[0].partition(BESIDE)
                if not meaning and any("Enum" in str(base) for base in cls.bases):
                    meaning = str(member.value).strip("\"'")
                if meaning:
                    fields.append(f"- `{name}`: {meaning}")
        if fields and cls.docstring:
            cls.docstring.value = "\n\n".join([cls.docstring.value, "\n".join(fields)])
