"""What a reproduction leaves behind: figures and their tables, the claims, and one page with all of it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import plotly.io
from plotly.offline import get_plotlyjs

from uavrl.evaluation.episode import Episode
from uavrl.evaluation.report import write_text
from uavrl.experiments import claims, judges, plots, tables
from uavrl.experiments.paper import FIGURES, PROTOCOLS
from uavrl.experiments.runner import Row, Run
from uavrl.viewer.page import episode_figure

ABOUT = (
    "Made by `uavrl reproduce`, scale {scale}. Differences and their 95 % intervals are over training seeds and test "
    "environments, paired over the environments; positive is in the claim's favour. A claim holds where its intervals "
    "are clear of zero, or of the number it names, on its side; it does not where one is clear on the other side; else "
    "it is open. Of several readings it depends on the reading where it holds under some; where it fails under one and "
    "holds under none, it does not hold. The last column says where a claim is judged otherwise."
)
SMOKE = " **The smallest scale shows that everything runs: of the paper it says nothing.**"
_FRAMES = 80  # of a flight on the page


def seeds_of(runs: Sequence[Run], rows: Mapping[str, Row]) -> tuple[list[Row], set[int]]:
    """Rows with the training seeds that every variant has finished, named as this figure names them; and these seeds.

    No rows where a variant has none in common with the others, or a policy that does not learn is missing.
    """
    if any(run.problem == "policy" and run.key not in rows for run in runs):
        return [], set()
    finished: dict[str, set[int]] = {}
    for run in runs:
        if run.problem != "policy":
            finished.setdefault(run.variant, set()).update({run.seed} if run.key in rows else set())
    common = set.intersection(*finished.values()) if finished else set()
    chosen = [run for run in runs if run.problem == "policy" or run.seed in common] if common else []
    return [{**rows[run.key], "variant": run.variant} for run in chosen], common


def finished_figures(figures: Mapping[str, Sequence[Run]], rows: Mapping[str, Row]) -> dict[str, list[Row]]:
    """Figures that can be drawn, with their rows."""
    found = {name: seeds_of(runs, rows)[0] for name, runs in figures.items()}
    return {name: done for name, done in found.items() if done}


def write_results(
    figures: Mapping[str, Sequence[Run]], rows: Mapping[str, Row], out: Path, scale: str, chosen: Sequence[str] = ()
) -> list[str]:
    """Draw the figures that have a training seed of each of their variants, with their tables; says a line for each.

    Args:
        figures: every figure's runs, by which the claims are judged.
        rows: finished runs by key.
        out: directory, made where missing.
        scale: its name.
        chosen: names of the figures to draw; all of them where there is none.

    Raises:
        ConfigError: a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    done, said = finished_figures(figures, rows), []
    for name in chosen or figures:
        runs = figures[name]
        missing = sum(run.key not in rows for run in runs)
        left = f"{missing} of {len(runs)} runs are missing"
        if name not in done:
            said.append(f"{name}: {left}, not drawn")
            continue
        plots.draw(name, done[name], out)
        parts = [f"# {FIGURES[name].title}", f"![{FIGURES[name].title}]({name}.png)"]
        parts += [tables.markdown(tables.table(done[name])), made(done[name], missing)]
        write_text(out / f"{name}.md", "\n\n".join(parts) + "\n")
        said.append(f"{name}: {out / name}.png, .pdf, .csv, .md" + (f"; {left}" if missing else ""))
    found = claims.judged(judges.Results(done))
    text = [
        "# The paper's claims",
        f"Eldeeb & Alves, arXiv:2606.16331. {claims.counted(found)}.",
        about(scale) + " The figures beside this file, each with its table, say what was run.",
        tables.markdown(claims.table(found)),
    ]
    write_text(out / "CLAIMS.md", "\n\n".join(text))
    return [*said, f"claims: {out / 'CLAIMS.md'}"]


def about(scale: str) -> str:
    """How claims are judged."""
    readings = "; ".join(f"{protocol.name}: {protocol.title}" for protocol in PROTOCOLS.values())
    return f"{ABOUT.format(scale=scale)} Readings: {readings}." + (SMOKE if scale == "smoke" else "")


def made(rows: Sequence[Row], missing: int) -> str:
    """How a figure's numbers were made."""
    learned = [row for row in rows if row["problem"] != "policy"]
    setting, machines = rows[0]["options"], {(row["machine"]["processor"], row["machine"]["commit"]) for row in rows}
    networks = sorted({row["settings"]["network"]["kind"] for row in learned})
    parts = [
        f"Scenario {setting['scenario']['name']}",
        {"fixed": "one layout", "random": "unseen layouts"}[setting["layouts"]],
        " and ".join({"mlp": "perceptron", "devices": "set network"}[kind] for kind in networks),
        "training seeds " + ", ".join(str(seed) for seed in sorted({row["seed"] for row in learned})),
        "updates " + ", ".join(f"{count:,}" for count in sorted({row["updates"] for row in learned})),
        f"{setting['episodes']} environments x {setting['fading_seeds']} fading seeds, seed {setting['seed']:,}",
        "last checkpoints",
        f"{sum(row['seconds'] for row in rows) / 3600:.1f} core-hours",
        *(f"{processor}, commit {(commit or 'unknown')[:9]}" for processor, commit in sorted(machines)),
        *([f"{missing} runs of this scale are missing"] if missing else []),
    ]
    return "; ".join(parts) + "."


def report_page(
    figures: Mapping[str, Sequence[Run]],
    rows: Mapping[str, Row],
    drawn: Path,
    scale: str,
    episodes: Sequence[Episode] = (),
) -> str:
    """One self-contained HTML page: claims, figures with their tables and how they were made, flights to play.

    Args:
        figures: every figure's runs.
        rows: finished runs by key.
        drawn: where `write_results` has written.
        scale: its name.
        episodes: flights to play, in one scenario.
    """
    done = finished_figures(figures, rows)
    found = claims.judged(judges.Results(done))
    parts = [
        "<p>Eldeeb &amp; Alves, <i>Diffusion Offline Reinforcement Learning for Fair and Energy-Efficient UAV-Assisted "
        'Wireless Networks</i>, <a href="https://arxiv.org/abs/2606.16331">arXiv:2606.16331</a>: its figures computed '
        f"anew, its claims judged. {escape(claims.counted(found))}.</p>",
        _contents(["Claims", *(FIGURES[name].title for name in done), *(["Flights"] if episodes else [])]),
        _heading("Claims"),
        f"<p>{_words(about(scale))}</p>",
        _table(claims.table(found), "claims"),
    ]
    for name, own in done.items():
        picture = base64.b64encode((drawn / f"{name}.png").read_bytes()).decode()
        missing = sum(run.key not in rows for run in figures[name])
        parts += [
            _heading(FIGURES[name].title),
            f'<img src="data:image/png;base64,{picture}" alt="{escape(FIGURES[name].title)}">',
            _table(tables.table(own)),
            f"<p class='made'>{escape(made(own, missing))}</p>",
        ]
    if episodes:
        parts += [_heading("Flights"), f"<script>{get_plotlyjs()}</script>"]
    for episode in episodes:
        flight = plotly.io.to_html(
            episode_figure(episode, _FRAMES),
            validate=False,
            full_html=False,
            include_plotlyjs=False,
            auto_play=False,
            default_height="100%",
            config={"responsive": True, "displaylogo": False},
        )
        returned = f"{escape(episode.policy)}: return {episode.total_reward:.4g}"
        parts.append(f"<h3>{returned}</h3><div class='wide'><div class='flight'>{flight}</div></div>")
    return _PAGE.format(title=f"uavrl: the paper, figure by figure ({escape(scale)})", body="\n".join(parts))


def _anchor(title: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in title.lower())


def _heading(title: str) -> str:
    return f'<h2 id="{_anchor(title)}">{escape(title)}</h2>'


def _contents(titles: Sequence[str]) -> str:
    return "<nav>" + "".join(f'<a href="#{_anchor(title)}">{escape(title)}</a>' for title in titles) + "</nav>"


def _words(text: str) -> str:
    return escape(text).replace("**", "").replace("`", "")


def _table(lines: Sequence[Sequence[str]], kind: str = "numbers") -> str:
    header, *rest = lines
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(_cell(cell) for cell in cells) + "</tr>" for cells in rest)
    return f"<div class='wide'><table class='{kind}'><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _cell(text: str) -> str:
    kinds = {judges.HOLDS: "holds", judges.FAILS: "fails", judges.READING: "reading"}
    kind = f' class="{kinds[text]}"' if text in kinds else ""
    lines = escape(text).replace("\n", "<br>")
    return f"<td{kind}>{lines}</td>"


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
  body {{ margin: 0; padding: 16px; color: #222; background: #fff; font: 15px/1.5 Helvetica, Arial, sans-serif; }}
  main {{ max-width: 1100px; margin: 0 auto; }}
  h1 {{ font-size: 24px; }} h2 {{ font-size: 19px; margin-top: 40px; }} h3 {{ font-size: 16px; }}
  nav a {{ display: inline-block; margin: 0 14px 4px 0; }}
  img {{ max-width: 100%; height: auto; }}
  .wide {{ overflow-x: auto; }}
  .flight {{ min-width: 900px; height: 640px; }}
  table {{ border-collapse: collapse; font-size: 13px; margin: 12px 0; }}
  th, td {{ border-bottom: 1px solid #ddd; padding: 4px 8px; text-align: left; vertical-align: top; }}
  td:not(:first-child) {{ min-width: 4.5em; }} .claims td:nth-child(4) {{ min-width: 20em; }}
  .claims td:nth-child(6) {{ min-width: 14em; }}
  .holds {{ color: #00684c; font-weight: bold; }} .fails {{ color: #a33c00; font-weight: bold; }}
  .reading {{ color: #6b5200; font-weight: bold; }}
  .made {{ color: #555; font-size: 13px; }}
  @media (max-width: 700px) {{  /* a telephone: a claim's cells one below the other */
    .claims thead {{ display: none; }} .claims tr {{ display: block; border-bottom: 1px solid #ddd; padding: 6px 0; }}
    .claims td, .claims td:nth-child(n) {{ display: block; min-width: 0; border: none; padding: 1px 0; }}
    .claims td:nth-child(2) {{ font-weight: bold; }} .claims td:nth-child(3) {{ color: #555; }}
  }}
</style>
</head>
<body>
<main>
<h1>{title}</h1>
{body}
</main>
</body>
</html>
"""
