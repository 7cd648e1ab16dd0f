"""Tables of comparisons for the terminal."""

import io

from rich.console import Console

from unbake.comparison import tables
from unbake.comparison.tables import print_comparison, print_step_times

START = {"heldout": {"render_psnr": 11.0, "albedo_psnr": 12.25}}
LENGTH = {"steps": 5, "samples": 2_560_000, "seconds": 2.0, "milliseconds_per_step": None}


def printed(show, content, width=200):
    console = Console(file=io.StringIO(), width=width)
    show(content, console)
    return console.file.getvalue()


def compared(methods):
    return {"untrained": START, "methods": methods, "time_to_quality": []}


def test_untrained_fields_are_the_first_row():
    text = printed(print_comparison, compared({"ours": LENGTH | {"heldout": {"albedo_psnr": 9.5}}}))
    rows = [line.split("│")[1:] for line in text.splitlines() if line.startswith("│")]
    cells = [[cell.strip() for cell in row] for row in rows]
    assert cells[0][:4] == ["untrained", "11.0", "12.2", "0"] and not any(cells[0][4:])
    assert cells[1][:7] == ["ours", "—", "9.5", "5", "2.6", "2 s", "—"]


def test_a_comparison_has_a_column_for_each_quantity(monkeypatch):
    monkeypatch.setattr(tables, "QUANTITIES", (*tables.QUANTITIES, "gloss"))
    means = {"render_psnr": 20.0, "albedo_psnr": 30.125, "roughness_psnr": None}
    methods = {"ours": LENGTH | {"heldout": means}, "prb": {"error": "no memory"}}
    text = printed(print_comparison, compared(methods))
    assert "albedo" in text and "roughness" in text and "gloss" not in text
    assert " 30.1 " in text and "—" in text and "failed" in text
    methods["ours"]["heldout"] = means | {"gloss_psnr": 17.0}
    text = printed(print_comparison, compared(methods))
    assert "gloss" in text and " 17.0 " in text


def test_aligned_albedo_has_a_column_where_some_run_has_it():
    means = {"render_psnr": 20.0, "albedo_psnr": 12.5, "albedo_psnr_aligned": 31.75}
    marks = {"representation": "neural", "yardsticks": {"constant": {"albedo_psnr": 15.0}}}
    methods = {"ours": LENGTH | marks | {"heldout": means}}
    text = printed(print_comparison, compared(methods))
    rows = [[c.strip() for c in x.split("│")[1:6]] for x in text.splitlines() if x[:1] == "│"]
    assert "albedo, aligned" in text
    assert rows[0] == ["untrained", "11.0", "12.2", "—", "0"]
    assert rows[1] == ["ours", "20.0", "12.5", "31.8", "5"]
    assert rows[2][:4] == ["constant", "", "15.0", ""]
    del means["albedo_psnr_aligned"]
    assert "aligned" not in printed(print_comparison, compared(methods))


def test_yardsticks_are_the_last_rows():
    low, high = {"albedo_psnr": 12.0}, {"albedo_psnr": 33.25}
    own = {"representation": "neural", "yardsticks": {"ceiling": high, "constant": low}}
    row = LENGTH | {"heldout": {"render_psnr": 20.0, "albedo_psnr": 28.0}}
    methods = {"ours": row | own, "prb": row | own, "direct": row | {"representation": "grid"}}
    lines = printed(print_comparison, compared(methods), width=80).splitlines()
    rows = [[c.strip() for c in line.split("│")[1:4]] for line in lines if line.startswith("│")]
    assert rows[-2:] == [["constant", "", "12.0"], ["ceiling", "", "33.2"]]
    methods["direct"]["yardsticks"] = {"ceiling": {"albedo_psnr": 31.5}, "constant": low}
    text = printed(print_comparison, compared(methods))
    assert "ceiling neural" in text and "ceiling grid" in text and "constant grid" not in text
    methods["prb"] = row | {"representation": "neural", "yardsticks": {"ceiling": None}}
    assert "33.2" in printed(print_comparison, compared(methods))


def test_what_scores_cannot_tell_is_said_below_them():
    means = {"render_psnr": 22.06, "albedo_psnr": 28.0}
    marks = {"representation": "neural", "yardsticks": {"constant": {"albedo_psnr": 12.0}}}
    content = compared({"ours": LENGTH | marks | {"heldout": means}})
    text = " ".join(printed(print_comparison, content, width=80).split())
    assert "22.1" in text and "22.06" not in text and "One fit of each method: its spread" in text
    assert "told with --evaluate-truth alone" in text and "true materials" not in text
    content["methods"]["ours"]["heldout"] = means | {"true_render_psnr": 24.53}
    text = printed(print_comparison, content, width=80)
    rows = [[c.strip() for c in line.split("│")[1:4]] for line in text.splitlines() if "│" in line]
    assert rows[-1] == ["true", "24.5", ""] or rows[-1] == ["true materials", "24.5", ""]
    assert "--evaluate-truth" not in text
    del content["methods"]["ours"]["yardsticks"], means["albedo_psnr"]
    content["methods"]["ours"]["heldout"] = means  # nobody knows the true materials
    assert "--evaluate-truth" not in printed(print_comparison, content)


def test_scores_of_methods_fit_into_80_columns():
    means = {"render_psnr": 24.4, "albedo_psnr": 31.8, "roughness_psnr": 27.1}
    row = {"steps": 2400, "samples": 66_860_971, "seconds": 120.0, "milliseconds_per_step": 98.5}
    methods = {name: row | {"heldout": means} for name in ("ours", "prb", "with-second-bounce")}
    text = printed(print_comparison, compared(methods), width=80)
    assert max(map(len, text.splitlines())) <= 80 and "66.9" in text


def test_what_is_known_of_lighting_is_printed():
    light = {"sh_error": 0.125, "sh_error_aligned": 0.5}
    light |= {"relight_psnr": 31.0, "relight_psnr_aligned": 32.0}
    emission = [{"name": "lamp", "emission_error": 0.25}, {"name": "dark", "emission_error": None}]
    row = LENGTH | {"heldout": {}, "environment": light, "emission": emission}
    text = printed(print_comparison, compared({"ours": row}))
    assert "12.5 %" in text and "32.0 dB" in text
    assert "ours: lamp 25.00 % off" in text and "dark" not in text


def test_the_time_to_quality_of_many_runs_fits_into_80_columns():
    runs = ["ours", "prb", "prb-neural-split-halves", "prb-bitmap", "ad-pt-neural-split-halves"]
    runs += ["direct", "no-prior"]
    targets = [
        {"run": run, "quantity": quantity, "below": below, "psnr": 20.0 - below,
         "seconds": {name: None if name == "direct" else 1234.5 - i for name in runs}}
        for quantity in ("albedo", "roughness") for i, run in enumerate(runs) for below in (0.0, 1)
    ]  # fmt: skip
    told = compared({}) | {"time_to_quality": targets}
    text = printed(print_comparison, told, width=80)
    race = text[text.index("Seconds to") :]
    assert "Seconds to albedo PSNR" in race and "Seconds to roughness PSNR" in race
    assert max(map(len, text.splitlines())) <= 80
    rows = [[c.strip() for c in line.split("│")[1:-1]] for line in race.splitlines() if "│" in line]
    assert rows[0] == ["1 ours", "20.0", *["1234"] * 5, "—", "1234"]
    assert rows[1][:3] == ["1 dB below", "19.0", "1234"]
    assert "".join(row[0] for row in rows).count("5ad-pt-neural-split-halves") == 2


def test_a_method_that_failed_has_no_step_time():
    names = {"method": "ours", "representation": None, "radiance": None, "estimator": "auto"}
    times = {"milliseconds_per_step": 12.5, "samples_per_second": 2e3, "times_the_first": None}
    text = printed(print_step_times, [names | times, names | {"method": "prb", "error": "no"}])
    assert "12.5" in text and "—" in text and "known" in text and "failed" in text


def test_long_names_are_folded_rather_than_cut():
    names = {"method": "with-second-bounce", "representation": "Fourier-features"}
    names |= {"radiance": "neural", "estimator": "split-halves"}
    times = {"milliseconds_per_step": 12.5, "samples_per_second": 2e3, "times_the_first": 1.0}
    text = printed(print_step_times, [names | times], width=80)
    rows = [line.split("│")[1:5] for line in text.splitlines() if line.startswith("│")]
    assert ["".join(cell.strip() for cell in column) for column in zip(*rows, strict=True)] == [
        *names.values()
    ]


def test_numbers_are_never_cut():
    means = {"render_psnr": 20.5, "albedo_psnr": 12.5, "albedo_psnr_aligned": 31.7}
    means |= {"roughness_psnr": 21.2, "metallic_psnr": 33.3}
    length = {"steps": 2400, "seconds": 5612.0, "milliseconds_per_step": 2338.5}
    row = length | {"samples": 561_234_567, "heldout": means}
    numbers = ["20.5", "12.5", "31.7", "21.2", "33.3", "2400", "5612 s", "2338.5", "561.2"]
    for width in (40, 80, 120, 200):
        text = printed(print_comparison, compared({"ad-pt-neural-split-halves": row}), width)
        assert "…" not in text
        assert all(f" {number} │" in text for number in numbers), width
        if width >= 120:
            assert max(map(len, text.splitlines())) <= width
