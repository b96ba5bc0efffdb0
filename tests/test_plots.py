"""Pictures of scans and phantoms: what is drawn is what is there, at its size."""

import matplotlib
import msgspec
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from test_pictures import text_of
from test_run import GEOMETRY, Double

from ctsim.benchmarks.scalebar import length_of, scale_bar
from ctsim.errors import InputError
from ctsim.phantoms.bodies.rods import MetalRods, Validation
from ctsim.phantoms.recipes import BUILDERS, build_recipe
from ctsim.reconstruct.log import line_integrals
from ctsim.reports import plots
from ctsim.reports.gallery import drawable, gallery, in_hu
from ctsim.reports.plots import plot_geometry, plot_projections

STACK = np.arange(7 * 4 * 5, dtype=np.float32).reshape(7, 4, 5)


@pytest.mark.parametrize(("width", "length"), [(60.0, 10.0), (66.7, 20.0), (3.4, 1.0), (0.2, 0.05), (1000.0, 200.0)])
def test_a_scale_bar_has_a_round_length_within_three_tenths(width, length):
    assert length_of(width) == pytest.approx(length, rel=1e-12)
    assert length <= 0.3 * width < 2.5 * length  # from 2 to 5 is the widest step


@pytest.mark.parametrize("shape", [(30, 40), (40, 12)])
def test_a_scale_bar_is_as_long_as_it_says(shape):
    axes = Figure().subplots()
    axes.imshow(np.zeros(shape), origin="lower", aspect=2.0)
    scale_bar(axes, shape, 1.5)
    (line,) = axes.lines
    (text,) = axes.texts
    assert np.ptp(line.get_xdata()) * 1.5 == pytest.approx(float(text.get_text().removesuffix(" mm")), rel=1e-12)
    x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
    assert x.min() > -0.5 and x.max() < shape[1] / 2 and -0.5 < y[0] == y[1] < shape[0] / 4
    assert axes.get_xlim() == (-0.5, shape[1] - 0.5) and axes.get_ylim() == (-0.5, shape[0] - 0.5)


def images(figure):
    return [image for axes in figure.axes for image in axes.images]


def test_a_still_picture_shows_the_views_that_were_asked_for():
    figure = plot_projections(STACK, (6, 0))
    first, second = images(figure)
    np.testing.assert_array_equal(first.get_array(), STACK[6])
    np.testing.assert_array_equal(second.get_array(), STACK[0])
    assert first.origin == "lower" and first.get_clim() == second.get_clim()
    assert "view 6" in text_of(figure)


@pytest.mark.parametrize("slider", [False, True])
def test_views_may_be_an_array_of_whole_numbers(slider):
    for views in (np.array([6, 0]), [6, 0], np.array([6, 0], np.uint8)):
        try:
            figure = plot_projections(STACK, views, slider=slider)
            np.testing.assert_array_equal(images(figure)[0].get_array(), STACK[6])
        finally:
            pyplot.close("all")
    assert len(images(plot_projections(STACK, np.array([], int)))) == 6


@pytest.mark.parametrize(
    "views", [3, 0.5, (0.5,), ("a",), "01", None, (None,), (True,), ((0, 1),), ((0,), 1), np.zeros((2, 40)), {0, 1}]
)
def test_views_of_another_kind_are_refused_in_one_sentence(views):
    with pytest.raises(InputError, match=r"^views: expected whole numbers such as \(0, 5\), got ") as caught:
        plot_projections(STACK, views)
    assert "\n" not in str(caught.value)


def test_six_views_from_the_first_to_the_last_are_shown_by_default(tmp_path):
    figure = plot_projections(STACK)
    shown = [int(image.get_array()[0, 0]) // 20 for image in images(figure)]
    assert shown[0] == 0 and shown[-1] == 6 and len(shown) == 6
    assert len(images(plot_projections(STACK[:2]))) == 2


def test_views_of_a_scan_are_line_integrals(tmp_path):
    scan = Double(folder=tmp_path, name="box").scan
    (image,) = images(plot_projections(scan, (3,)))
    np.testing.assert_array_equal(image.get_array(), line_integrals(scan, 3)[0].numpy())
    assert image.get_array().mean() == pytest.approx(np.log(2), rel=1e-6)  # 1000 counts of 2000; float32


@pytest.mark.parametrize("slider", [False, True])
def test_views_of_a_scan_have_a_scale_bar_at_the_detector(tmp_path, slider):
    scan = Double(folder=tmp_path, name="box").scan
    try:
        figure = plot_projections(scan, (3, 1), slider=slider)
        axes = figure.axes[0]
        (line,), (text,) = axes.lines, axes.texts
        length = length_of(GEOMETRY.s_detector[1])
        assert text.get_text() == f"{length:g} mm at the detector"
        assert np.ptp(line.get_xdata()) * GEOMETRY.d_detector[1] == pytest.approx(length, rel=1e-12)
        assert axes.get_aspect() == pytest.approx(GEOMETRY.d_detector[0] / GEOMETRY.d_detector[1])
        assert not any(axes.lines for axes in plot_projections(STACK, slider=False).axes)  # no one knows its pixels
    finally:
        pyplot.close("all")


def test_the_slider_turns_the_views():
    try:
        figure = plot_projections(STACK, (2,), slider=True)
        (image,) = images(figure)[:1]
        np.testing.assert_array_equal(image.get_array(), STACK[2])
        vars(figure)["slider"].set_val(5)
        np.testing.assert_array_equal(image.get_array(), STACK[5])
    finally:
        pyplot.close("all")


def test_a_window_is_opened_only_where_there_are_windows(monkeypatch):
    assert not plots.is_interactive()
    plot_projections(STACK)
    assert pyplot.get_fignums() == []
    monkeypatch.setattr(matplotlib, "get_backend", lambda: "QtAgg")
    assert plots.is_interactive()


def test_one_view_and_even_counts_have_a_window_too():
    for stack in (np.zeros((1, 3, 3)), np.full((2, 3, 3), np.nan), np.ones((1, 3, 3), np.uint16)):
        figure = plot_projections(stack)
        low, high = images(figure)[0].get_clim()
        assert low < high
        figure.canvas.draw()
    try:
        plot_projections(np.zeros((1, 3, 3)), slider=True).canvas.draw()
    finally:
        pyplot.close("all")


def test_what_is_no_stack_is_refused():
    for given in (np.zeros((3, 3)), np.zeros((0, 3, 3)), np.zeros((2, 3, 3), complex)):
        with pytest.raises(InputError, match="expected a scan or real numbers"):
            plot_projections(given)
    with pytest.raises(InputError, match="view must be within 0 to 6, got 7"):
        plot_projections(STACK, (7,))


@pytest.mark.parametrize("posed", [False, True])
def test_the_geometry_is_drawn_at_its_place(posed):
    geometry = msgspec.structs.replace(GEOMETRY, off_detector=(3.0, 2.0), off_origin=(1.0, 0.0, 5.0))
    if posed:
        poses = tuple(map(tuple, geometry.pose_array().tolist()))
        geometry = msgspec.structs.replace(geometry, poses=poses)
    figure = plot_geometry(geometry)
    above, side = figure.axes
    # view 0: the source at x = 100, the detector's 20 pixels of 1.5 mm about y = 2 at x = −50; 18 of them about z = 3
    for axes, source, volume, detector in (
        (above, (100.0, 0.0), (-3.0, 13.0, -7.0, 7.0), (-50.0, -50.0, -13.0, 17.0)),
        (side, (100.0, 0.0), (-3.0, 13.0, -5.0, 7.0), (-50.0, -50.0, -10.5, 16.5)),
    ):
        drawn = {p.get_label(): p.get_xy() for p in axes.patches if isinstance(p, Polygon)}
        for label, expected in (("volume", volume), ("detector", detector)):
            (x0, y0), (x1, y1) = drawn[label].min(0), drawn[label].max(0)
            assert (x0, x1, y0, y1) == pytest.approx(expected, abs=1e-9)
        (point,) = (line for line in axes.lines if line.get_label() == "source")
        assert (point.get_xdata()[0], point.get_ydata()[0]) == pytest.approx(source, abs=1e-9)
        assert len(axes.lines[0].get_xdata()) == 6
    assert ("by poses" if posed else "over 360°") in text_of(figure)


def test_every_recipe_without_a_file_is_in_the_gallery():
    assert {*BUILDERS} - {*drawable()} == {kind for kind in BUILDERS if kind.__struct_config__.tag == "ct_volume"}


def test_the_gallery_shows_a_body_in_hu_and_its_metal_over_it():
    figure = gallery([Validation, MetalRods], n_voxel=16)
    shown = [image.get_array() for image in images(figure)]
    assert len(shown) == 8  # a body and its metal in each of two slices of two recipes
    for body, metal in zip(shown[::2], shown[1::2], strict=True):
        drawn = ~np.ma.getmaskarray(metal)
        assert 0 < drawn.sum() < drawn.size / 2
        # at least half of a drawn voxel is metal, which attenuates most
        assert (body[drawn] + 1000).mean() > (body[~drawn] + 1000).max() / 2
    text = text_of(figure)
    assert "validation" in text and "metal_rods" in text and " mm" in text


def test_water_has_no_hu():
    recipe = Validation(n_voxel=(16, 16, 16), metal="none")
    volume, metal, d_voxel = in_hu(build_recipe(recipe, 1), 60.0, 16)
    assert not metal.any() and d_voxel == 60 / 16
    assert volume[8, 8, 8] == pytest.approx(0, abs=1e-3) and volume[0, 0, 0] == pytest.approx(-1000)  # float32
