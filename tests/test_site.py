"""What docs/hooks.py makes of the pages, and that the page on the method names functions that exist."""

import importlib
import importlib.util
import re

import pytest

import fmpjax
from fmpjax import priors
from tests.helpers import ROOT


@pytest.fixture(scope="module")
def hooks():
    """The hooks of the site, where `make docs` has installed what they need."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("latex2mathml")
    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs" / "hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("page", "text", "there", "paths"),
    [
        ("index.md", "[a](docs/play.md#the-page)", "[a](play.md#the-page)", {"docs/play.md"}),
        ("index.md", "[a](examples/own_prior.py)", "[a](examples/own_prior.py.md)", {"examples/own_prior.py"}),
        ("index.md", "![a](docs/play.jpg)", "![a](play.jpg)", {"docs/play.jpg"}),
        ("play.md", "[a](../CHANGELOG.md)", "[a](changelog.md)", {"CHANGELOG.md"}),
        ("changelog.md", "[a](docs/play.md)", "[a](play.md)", {"docs/play.md"}),
        ("play.md", "[a](../benchmarks)", "[a](benchmarks/index.md)", {"benchmarks"}),
        ("play.md", "[a](../robots/strider)", "[a](robots/strider/index.md)", {"robots/strider"}),
        ("experiments/index.md", "[a](table1.toml)", "[a](table1.toml.md)", {"experiments/table1.toml"}),
        ("experiments/index.md", "[a](../docs/play.md)", "[a](../play.md)", {"docs/play.md"}),
        ("play.md", "[a](#the-page) [b](https://x.org/a.md)", "[a](#the-page) [b](https://x.org/a.md)", set()),
        ("play.md", "```\n[a](../README.md)\n```\n[a](../README.md)", "```\n[a](../README.md)\n```\n[a](index.md)",
         {"README.md"}),
    ],
)  # fmt: skip
def test_links_to_the_checkout_become_links_within_the_site(hooks, page, text, there, paths):
    assert hooks.rewrite(text, page) == (there, paths)


def test_a_folder_is_a_page_of_its_files(hooks, tmp_path, monkeypatch):
    monkeypatch.setattr(hooks, "ROOT", tmp_path)
    (folder := tmp_path / "results").mkdir()
    (folder / "deeper").mkdir()
    (folder / "curves.png").touch()
    (folder / "provenance.json").write_text('{"command": "fmpjax train", "commit": "abc"}')
    text = hooks.listing(folder)
    assert "# results\n" in text and "Commit `abc`, by\n\n```sh\nfmpjax train\n```" in text
    assert "![curves.png](curves.png)" in text
    assert text.endswith(
        "- [deeper/](./deeper)\n- [curves.png](./curves.png)\n- [provenance.json](./provenance.json)\n"
    )


def test_formulas_become_mathml_and_an_unknown_command_is_refused(hooks):
    made = hooks.on_page_content(r'<p><span class="arithmatex">\(a &lt; b^2\)</span></p>')
    assert made.startswith('<p><span class="formula"><math') and "<mo>&#x0003C;</mo>" in made
    made = hooks.on_page_content('<div class="arithmatex">\\[\nx\n\\]</div>')
    assert 'display="block"' in made
    with pytest.raises(hooks.PluginError, match=r"\\nosuch"):
        hooks.on_page_content(r'<span class="arithmatex">\(\nosuch{x}\)</span>')


def test_a_site_that_loads_from_elsewhere_is_refused(hooks, tmp_path):
    config = hooks.MkDocsConfig()
    config.site_dir = str(tmp_path)
    page = tmp_path / "index.html"
    page.write_text('<a href="https://x.org">x</a><script src="a.js"></script><link rel="icon" href="../a.png">')
    hooks.on_post_build(config)
    page.write_text('<link rel="stylesheet" href="https://fonts.x.org/a.css">')
    with pytest.raises(hooks.PluginError, match=r"loads https://fonts\.x\.org/a\.css"):
        hooks.on_post_build(config)


def _named():
    """What the method's page says is in the code."""
    page = (ROOT / "docs" / "method.md").read_text()
    paragraphs = re.findall(r"^In the code: (.*?)(?:\n\n|\Z)", page, re.MULTILINE | re.DOTALL)
    cells = re.findall(r"^\|.*\| (`[\w.]+`) \|$", page, re.MULTILINE)
    return sorted({name for text in [*paragraphs, *cells] for name in re.findall(r"`([a-z]\w*(?:\.\w+)+)`", text)})


@pytest.mark.parametrize("name", _named())
def test_the_page_on_the_method_names_what_is_there(name):
    parts = name.split(".")
    for split in range(len(parts) - 1, 0, -1):
        try:
            found = importlib.import_module(".".join(["fmpjax", *parts[:split]]))
        except ModuleNotFoundError:
            continue
        for part in parts[split:]:
            found = getattr(found, part)
        assert found is not None
        return
    raise AssertionError(name)


def test_the_reference_has_every_public_name():
    page = (ROOT / "docs" / "reference.md").read_text()
    listed = re.findall(r"^::: fmpjax\.(\w+)$", page, re.MULTILINE)
    assert sorted(listed) == sorted(fmpjax.__all__)


def test_the_page_on_priors_has_every_method():
    page = (ROOT / "docs" / "priors.md").read_text()
    assert re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE) == list(priors.METHODS)
