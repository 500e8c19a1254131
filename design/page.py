"""The frame of the report: one HTML page without network or files beside it."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape

from design.theme import DARK, LIGHT

#: Hand-written; the colours come from `theme`. It contains braces, so it is joined, not formatted.
CSS = """
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%}
body{margin:0;background:var(--page);color:var(--ink);
 font:15.5px/1.55 system-ui,-apple-system,"Segoe UI",Inter,Roboto,"Helvetica Neue",Arial,sans-serif}
main{max-width:1120px;margin:0 auto;padding:44px 24px 72px}
h1{font-size:clamp(27px,3.6vw,38px);line-height:1.16;letter-spacing:-.022em;margin:10px 0 14px;
 font-weight:680;max-width:26em;text-wrap:balance}
h2{font-size:21px;letter-spacing:-.012em;line-height:1.25;margin:0 0 6px;font-weight:650}
h3{font-size:14px;margin:0 0 10px;font-weight:650}
p{margin:0 0 12px;max-width:74ch}
.lead{font-size:18px;line-height:1.5;max-width:66ch;text-wrap:pretty}
.muted,small,figcaption{color:var(--muted)}
a{color:var(--best);text-underline-offset:2px}
.kicker{display:flex;flex-wrap:wrap;gap:10px;align-items:center;color:var(--muted);font-size:13.5px}
.badge{border-radius:99px;padding:3px 11px;font-weight:600;font-size:12.5px;
 background:color-mix(in srgb,var(--tone) 13%,transparent);color:var(--tone)}
.ok{--tone:var(--good)}.warn{--tone:var(--bad)}
section{margin-top:52px}
section>h2+figure,section>h2+div{margin-top:16px}section>p:first-of-type{margin-bottom:18px}
.card{background:var(--paper);border:1px solid var(--line);border-radius:12px;padding:22px 24px}
.answer{display:grid;grid-template-columns:minmax(0,1.22fr) minmax(0,1fr);gap:28px;margin-top:28px}
.answer>.card{display:flex;flex-direction:column;justify-content:center}
.stack{display:flex;flex-direction:column;gap:16px}
.tiles{display:grid;grid-template-columns:1fr 1fr;gap:16px;flex:1}
.tile{background:var(--paper);border:1px solid var(--line);border-radius:12px;padding:16px 18px}
.tile b{display:block;font-size:27px;letter-spacing:-.025em;line-height:1.15;font-weight:650;
 margin:3px 0 9px;font-variant-numeric:tabular-nums}
.tile b i{font-style:normal;font-size:16px;color:var(--muted);font-weight:500;letter-spacing:0}
.tile>span{display:block;font-size:13.5px;line-height:1.45}
.tile em{font-style:normal;color:var(--muted)}
.change small{display:inline;color:inherit;font-weight:500}
.fine{color:var(--muted);font-size:13.5px;margin:14px 0 0}
.nowrap{white-space:nowrap}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums;font-size:14.5px}
th{font-weight:550;color:var(--muted);font-size:13px;text-align:right;padding:0 0 8px 18px;
 vertical-align:bottom;line-height:1.3}
td{text-align:right;padding:9px 0 9px 18px;border-top:1px solid var(--line);white-space:nowrap;
 vertical-align:top}
th:first-child,td:first-child{text-align:left;padding-left:0;white-space:normal}
td small{display:block;font-size:12.5px;line-height:1.4;max-width:46ch}
td.text,th.text{text-align:left;white-space:normal}
/* A table that is wider than its card fades out where more of it is to be scrolled to. */
.scroll{overflow-x:auto;background:
 linear-gradient(90deg,var(--paper) 40%,transparent) left/36px 100% no-repeat local,
 linear-gradient(270deg,var(--paper) 40%,transparent) right/36px 100% no-repeat local,
 linear-gradient(90deg,var(--line),transparent) left/14px 100% no-repeat,
 linear-gradient(270deg,var(--line),transparent) right/14px 100% no-repeat}
.key{font-weight:650}
.better{color:var(--good);font-weight:600}.worse{color:var(--bad);font-weight:600}
.same{color:var(--muted)}
.dot{display:inline-block;width:.72em;height:.72em;border-radius:3px;margin-right:.5em}
.dot.best{background:var(--best)}.dot.none{background:var(--none)}
.dot.own{border:1.6px dashed var(--own)}.dot.ownfill{background:var(--own)}
.dot.sand{background:var(--sand)}.dot.area{border:1.4px dashed var(--muted)}
.legend{display:flex;flex-wrap:wrap;gap:4px 18px;font-size:13px;color:var(--muted);margin-top:10px}
figure{margin:0 0 16px}
figure img,figure svg{display:block;width:100%;height:auto}
figcaption{font-size:13.5px;margin-top:12px;max-width:86ch}
figure.film{background:#1b1917;border-color:#1b1917}
figure.film img{max-width:902px;margin:0 auto;border-radius:6px}
figure.film figcaption{color:#a59e92}
img.dark{display:none!important}
figure.flow{--rest:var(--sand);--quick:var(--bad)}
.flow .panels{display:grid;grid-template-columns:repeat(auto-fit,minmax(300px,1fr));gap:18px}
.flow canvas{display:block;width:100%;aspect-ratio:16/10;touch-action:none;cursor:grab}
.flow .numbers{display:grid;grid-template-columns:1fr 1fr;gap:2px 16px;font-size:13.5px;
 color:var(--muted);margin:8px 0 0;font-variant-numeric:tabular-nums}
.flow .numbers b{color:var(--ink);font-weight:600}
.flow .time{display:flex;gap:14px;align-items:center;margin-top:16px}
.flow input{flex:1;accent-color:var(--best)}
.flow output{min-width:6em;text-align:right;font-variant-numeric:tabular-nums}
.flow button{font:inherit;font-size:13.5px;min-width:5.2em;padding:4px 12px;border-radius:8px;
 border:1px solid var(--line);background:var(--ground);color:var(--ink);cursor:pointer}
svg .ground{fill:var(--ground);stroke:var(--line)}
svg .release{fill:var(--sand);fill-opacity:.5}
svg .best{fill:var(--best)}svg .ranked{fill:var(--sand)}
svg .ownfill{fill:var(--own)}
svg .own{fill:none;stroke:var(--own);stroke-width:1.8;stroke-dasharray:5 3.5}
svg .placement{fill:none;stroke:var(--muted);stroke-width:1.2;stroke-dasharray:2 4}
svg .keep-out{stroke:var(--bad);stroke-width:1}svg .hatch{stroke:var(--bad);opacity:.5}
svg .section{stroke:var(--muted);stroke-width:1;stroke-dasharray:1 3;fill:none}
svg .tick{stroke:var(--muted);stroke-width:1}
svg .arrow path{fill:none;stroke:var(--ink);stroke-width:1.7;opacity:.75}
svg text{fill:var(--ink);font-family:inherit}
svg .number{fill:var(--paper);font-size:16px;font-weight:700;text-anchor:middle}
svg .small{font-size:12px;fill:var(--muted)}
svg .on-sand{fill:var(--ink);text-anchor:middle;opacity:.8}
svg .middle{text-anchor:middle}svg .end{text-anchor:end}
svg.thumb{width:74px;height:auto;display:block;border-radius:3px}
pre{background:var(--ground);border:1px solid var(--line);border-radius:8px;padding:13px 15px;
 overflow-x:auto;font:13px/1.5 ui-monospace,SFMono-Regular,Menlo,Consolas,monospace;margin:0 0 16px;
 white-space:pre-wrap;overflow-wrap:anywhere}
.columns{display:grid;grid-template-columns:repeat(auto-fit,minmax(290px,1fr));gap:16px}
.columns table{font-size:13.5px}.columns td{padding:6px 0 6px 14px;overflow-wrap:anywhere;
 white-space:normal}.columns td:first-child{color:var(--muted);padding-left:0;white-space:nowrap}
.note{border-left:3px solid var(--bad);padding:2px 0 2px 16px;margin:22px 0 0}
.note p{margin:6px 0 0}.note ul{margin:4px 0 0;padding-left:18px}
footer{margin-top:56px;color:var(--muted);font-size:13px}
@media(max-width:820px){.answer{grid-template-columns:1fr}main{padding:28px 16px 48px}
 .card{padding:16px}.scroll td:first-child:not(:has(svg)){min-width:9.5em}}
"""

PRINT = """
@page{size:A4;margin:14mm}
/* Sizes are those of a screen; smaller by a third, its columns fit on paper. */
@media print{body{background:#fff}main{max-width:none;padding:0;zoom:.66}
 .card,.tile{border-color:#d8d4cc}section{margin-top:26px}.film,.flow{display:none}
 .card,.tile,figure,tr,p{break-inside:avoid}h2,h2+p{break-after:avoid}.scroll{background:none}
 .answer{grid-template-columns:1.2fr 1fr}a{color:inherit;text-decoration:none}}
"""


def document(title: str, body: str) -> str:
    """The whole page around `body`."""
    style = (
        f":root{{{LIGHT.css_variables()}}}{CSS}"
        f"@media screen and (prefers-color-scheme:dark){{:root{{{DARK.css_variables()}}}"
        "img.light{display:none!important}img.dark{display:block!important}}"
        f"{PRINT}"
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head>"
        f"<body><main>{body}</main></body></html>\n"
    )


def section(title: str, *content: str, intro: str = "") -> str:
    """A heading, an introducing sentence (HTML) and what follows."""
    first = f'<p class="muted">{intro}</p>' if intro else ""
    return f"<section><h2>{escape(title)}</h2>{first}{''.join(content)}</section>"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, text: Sequence[int] = ()) -> str:
    """A table of ready HTML cells; the columns in `text` are set to the left."""

    def cell(tag: str, k: int, content: str) -> str:
        return f"<{tag}{' class=text' if k in text else ''}>{content}</{tag}>"

    top = "".join(cell("th", k, h) for k, h in enumerate(head))
    body = "".join(
        f"<tr>{''.join(cell('td', k, c) for k, c in enumerate(row))}</tr>" for row in rows
    )
    header = f"<thead><tr>{top}</tr></thead>" if any(head) else ""
    return f'<div class="scroll"><table>{header}<tbody>{body}</tbody></table></div>'


def key_values(title: str, values: Iterable[tuple[str, str]]) -> str:
    """A small two-column table of plain text under a heading; "" if there is nothing to show."""
    rows = [(escape(k), escape(v)) for k, v in values]
    if not rows:
        return ""
    return f'<div class="card"><h3>{escape(title)}</h3>{table(("", ""), rows)}</div>'


def picture(light: bytes, dark: bytes, alt: str, caption: str) -> str:
    """A figure embedded in both themes; caption is HTML."""
    images = "".join(
        f'<img class="{name}" alt="{escape(alt)}" src="{data_uri(content, "image/png")}">'
        for name, content in (("light", light), ("dark", dark))
    )
    return f'<figure class="card">{images}<figcaption>{caption}</figcaption></figure>'


def film(content: bytes, alt: str, caption: str) -> str:
    """An embedded GIF, on dark in both themes; not printed."""
    return (
        f'<figure class="card film"><img alt="{escape(alt)}" '
        f'src="{data_uri(content, "image/gif")}"><figcaption>{caption}</figcaption></figure>'
    )


def data_uri(content: bytes, kind: str) -> str:
    """The bytes themselves as an address, so that the page can be mailed alone."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
