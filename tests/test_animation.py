"""Films show where the points are, in frames that stand still, and make files that need nothing else."""

from __future__ import annotations

import base64
import io
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.animation import AbstractMovieWriter, writers
from PIL import Image

import invariode as iv
from cases import dealt


@pytest.fixture
def films():
    """Makes films and draws each once, which matplotlib asks for before they go."""
    made = []

    def animate(sol, *args, **options):
        made.append(sol.animate(*args, **{"duration": 0.4, **options}))
        return made[-1]

    yield animate
    for film in made:
        film._init_draw()
        film._draw_was_started = True


def turning(**options):
    problem = iv.Problem(lambda t, y: [-y[1], y[0]], (0, 6), [1.0, 0.0], labels=["east", "north"], name="Turning")
    return problem.solve(rtol=1e-6, **{"dense_output": True, **options})


def lines(film):
    return film.figure.axes[0].lines


def hand(t, y):
    return [[0, 0], y]


def test_each_frame_shows_the_points_of_its_time(films):
    sol = turning()
    film = films(sol, hand, links=[(0, 1)])
    assert (len(film.times), film.times[0], film.times[-1]) == (10, 0, 6)
    link, dots = lines(film)
    for frame, t in enumerate(film.times):
        film.show(frame)
        np.testing.assert_array_equal(film.points[frame], [[0, 0], sol.sol(t)])
        np.testing.assert_array_equal(link.get_xydata(), film.points[frame])
        np.testing.assert_array_equal(dots.get_xydata(), film.points[frame])
        assert film.figure.axes[0].texts[0].get_text() == f"$t$ = {t:.2f}"


def test_backwards_and_without_dense_output_frames_follow_the_curve_of_the_steps(films):
    for end in (6, -6):
        film = films(iv.ode45(lambda t, y: [-y[1], y[0]], (0, end), [1.0, 0.0], rtol=1e-6, refine=1), [[0, 1]])
        turned = np.column_stack([np.cos(film.times), np.sin(film.times)])
        np.testing.assert_allclose(film.points[:, 0], turned, rtol=0, atol=1e-3)  # the chords of the steps: 0.02


def test_a_jump_is_not_smoothed(films):
    """Frames before the jump and after it show the states there, without dense output too."""
    jump = iv.Event(lambda t, y: t - 1, action=lambda t, y: [y[0] + 5, y[1]])
    film = films(iv.ode45(lambda t, y: [0, 1], (0, 2), [0.0, 0.0], events=jump), [[0, 1]], trace=[0])
    assert set(film.points[:, 0, 0]) == {0, 5}
    assert set(film._shown.paths[:, 0, 0]) == {0, 5}


def test_backwards_too_frames_show_the_nearest_of_the_times_in_t_eval(films):
    for t_span in ((0, 6), (0, -6)):
        sol = iv.ode45(lambda t, y: [-y[1], y[0]], t_span, [1.0, 0.0], t_eval=np.linspace(*t_span, 25))
        film = films(sol, [[0, 1]])
        for t, (point,) in zip(film.times, film.points, strict=True):
            nearest = np.abs(sol.t - t)
            assert any(np.array_equal(point, sol.y[:, k]) for k in np.flatnonzero(nearest == nearest.min()))


def test_points_can_be_labels_or_indices(films):
    sol = turning()
    for points in (["east", "north"], [0, 1], [["east", 1]], np.array([[0, -1]])):
        film = films(sol, points)
        np.testing.assert_array_equal(film.points[:, 0], sol.sol(film.times).T)


def test_a_path_grows_behind_its_point_and_has_no_corners(films):
    film = films(turning(), hand, trace=[1])
    path = lines(film)[0]
    for frame in (0, 4, 9):
        film.show(frame)
        drawn = path.get_xydata()
        np.testing.assert_array_equal(drawn[-1], film.points[frame, 1])
        np.testing.assert_array_equal(drawn[0], film.points[0, 1])
        angle = np.unwrap(np.arctan2(*drawn.T[::-1]))
        assert (np.diff(angle) < 0.01).all()


def test_the_axes_hold_the_motion_and_have_one_scale(films):
    film = films(turning(), hand, links=[(0, 1)], color="green")
    ax = film.figure.axes[0]
    before = ax.get_xlim(), ax.get_ylim(), ax.get_position().bounds
    for frame in range(len(film.times)):
        film.show(frame)
        film.figure.draw_without_rendering()
        assert (ax.get_xlim(), ax.get_ylim(), ax.get_position().bounds) == before
    (x0, x1), (y0, y1) = before[:2]
    assert x0 < film.points[..., 0].min() <= film.points[..., 0].max() < x1
    assert y0 < film.points[..., 1].min() <= film.points[..., 1].max() < y1
    scale = ax.transData.transform([[0, 0], [1, 1]])
    assert np.ptp(scale[:, 0]) == pytest.approx(np.ptp(scale[:, 1]))
    assert lines(film)[0].get_color() == "green"
    assert ax.get_title() == "Turning"


def test_in_space(films):
    sol = iv.ode45(lambda t, y: [-y[1], y[0], 0.1], (0, 6), [1.0, 0.0, 0.0], dense_output=True)
    film = films(sol, lambda t, y: [[0, 0, 0], y], links=[(0, 1)], trace=[1])
    film.show(7)
    assert film.figure.axes[0].name == "3d"
    np.testing.assert_array_equal(np.transpose(lines(film)[1].get_data_3d()), film.points[7])
    given = plt.figure().add_subplot(projection="3d")
    assert films(sol, [0, 1, 2], ax=given).figure is given.figure


def test_on_axes_that_are_given(films):
    ax = plt.figure().add_subplot()
    ax.plot([-3, 3], [0, 0])
    assert films(turning(), hand, ax=ax).figure is ax.figure
    assert ax.get_xlim()[0] < -3
    assert len(plt.get_fignums()) == 1


def test_a_gif_has_all_frames_and_they_differ(films, tmp_path):
    film = films(turning(), hand, links=[(0, 1)], duration=0.2)
    film.save(tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.n_frames == len(film.times) == 5
        assert picture.info["duration"] == 40  # milliseconds: 25 frames per second
        seen = set()
        for frame in range(5):
            picture.seek(frame)
            seen.add(picture.convert("RGB").tobytes())
        assert len(seen) == 5


class Frames(AbstractMovieWriter):
    """Keeps the pixels of each frame."""

    def setup(self, fig, outfile, dpi=None):
        super().setup(fig, outfile, dpi)
        self.pixels = []

    def grab_frame(self, **options):
        self.pixels.append(pixels(self.fig, self.dpi))

    def finish(self):
        pass


def pixels(figure, dpi):
    drawn = io.BytesIO()
    figure.savefig(drawn, format="rgba", dpi=dpi)
    return drawn.getvalue()


@dealt(dpi=[50, None], points=[hand, lambda t, y: [[0, 0, 0], [*y, t]]])
def test_saved_frames_are_those_of_the_whole_figure(films, points, dpi, tmp_path):
    """The standing parts, which are drawn once, are where they are in each frame, and are back afterwards."""
    film = films(turning(), points, links=[(0, 1)], trace=[1], duration=0.2)
    film.figure.axes[0].annotate("here", (0, 0))
    writer = Frames()
    film.save(tmp_path / "a", writer=writer, dpi=dpi)
    assert len(writer.pixels) == len(film.times)
    for frame, saved in enumerate(writer.pixels):
        film.show(frame)
        assert saved == pixels(film.figure, writer.dpi)


def test_a_page_has_its_frames_and_controls_and_needs_no_network(films, tmp_path):
    film = films(turning(), hand, duration=0.2)
    film.save(tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64") == len(film.times)
    assert not re.search(r"(src|href)\s*=\s*[\"']?(https?:)?//", page)
    assert 'class="fa' not in page
    assert page.count("<button") == 9
    assert film._repr_html_() in page


@pytest.mark.skipif(writers.is_available("ffmpeg"), reason="ffmpeg is here, and makes the file")
def test_without_ffmpeg_an_mp4_is_refused_with_advice(films, tmp_path):
    with pytest.raises(RuntimeError, match=r"\.mp4 needs the program ffmpeg.*save as \.gif or \.html"):
        films(turning(), hand).save(tmp_path / "a.mp4")


@pytest.mark.skipif(not writers.is_available("ffmpeg"), reason="ffmpeg is not installed")
def test_with_ffmpeg_there_are_mp4s(films, tmp_path):
    films(turning(), hand).save(tmp_path / "a.mp4")
    assert (tmp_path / "a.mp4").read_bytes()[4:8] == b"ftyp"


def test_a_film_takes_as_long_as_it_is_told(films):
    assert len(films(turning(), hand, duration=3, fps=10).times) == 30
    assert len(turning().animate(hand, fps=5).times) == 30  # six seconds, as the motion
    for motion, seconds in ((1, 4), (4, 4), (20, 20), (20.1, 8)):  # in real time, or as long as one likes to look
        sol = iv.solve_ivp(lambda t, y: [-y[1], y[0]], (0, motion), [1.0, 0.0], dense_output=True)
        film = sol.animate(hand, fps=5)
        assert len(film.times) == 5 * seconds
        film._draw_was_started = True
    for film in (turning().animate(hand, fps=5),):
        film._draw_was_started = True


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"points": lambda t, y: 1.0}, r"returned shape \(\).*return real numbers of shape \(k, 2\)"),
        ({"points": lambda t, y: [[1, 2, 3, 4]]}, r"returned shape \(1, 4\)"),
        ({"points": lambda t, y: [[0, np.nan]]}, "point 0 is not finite"),
        ({"points": [[0, 5]]}, "there is no component 5"),
        ({"points": [[0]]}, "rows of two or three components"),
        ({"points": hand, "links": [(0, 2)]}, "links must name points by indices from 0 to 1, got 2"),
        ({"points": hand, "trace": ["a"]}, "trace must name points by indices from 0 to 1, got 'a'"),
        ({"points": hand, "fps": 0}, "fps must be positive"),
        ({"points": hand, "fps": np.inf}, "duration times fps must be at most 108000 frames, got 6 s at inf"),
        ({"points": hand, "duration": 1e300}, r"duration times fps .*, got 1e\+300 s at "),
        ({"points": hand, "duration": -1}, "duration must be positive"),
        ({"points": lambda t, y: [*y, 0], "ax": "plane"}, 'give axes with projection="3d"'),
    ],
)
def test_what_cannot_be_shown_is_refused(options, message):
    if options.get("ax"):
        options = {**options, "ax": plt.figure().add_subplot()}
    with pytest.raises(ValueError, match=message):
        turning().animate(**options)


def test_a_mechanical_system_shows_its_own_points():
    """points(t, q) gets the positions only, and the arguments of the system."""

    def rod(t, q, length):
        return q @ q - length**2

    def pivot_and_bob(t, q, length):
        assert length == 2
        return [[0, 0], q]

    pendulum = iv.MechanicalSystem([1, 1], lambda t, q, v, length: [0, -1], rod, points=pivot_and_bob, args=(2.0,))
    sol = pendulum.problem((0, 5), [2, 0], [0, 0]).solve(dense_output=True)
    film = pendulum.animate(sol, links=[(0, 1)], trace=[1], fps=5)
    film._draw_was_started = True
    np.testing.assert_array_equal(film.points[-1], [[0, 0], sol.y[:2, -1]])
    with pytest.raises(ValueError, match="the system has no points: make it with points="):
        iv.MechanicalSystem([1, 1], lambda t, q, v: [0, -1]).animate(sol)
    with pytest.raises(TypeError, match="points"):
        iv.MechanicalSystem([1, 1], lambda t, q, v: [0, -1], points=[[0, 0]])


def test_nothing_moves_in_one_point():
    with pytest.raises(ValueError, match="cannot animate a solution with a single point"):
        turning(keep="end", dense_output=False).animate(hand)


def test_the_clock_stands_inside_the_figure_and_clear_of_the_title(films):
    """The law holds for a film whose axes are narrower than the two, and of one without a title."""
    for name in ("A narrow film", None):
        film = films(iv.Problem(lambda t, y: [1], (0, 9), [0.0], name=name).solve(), lambda t, y: [[0, y[0]]])
        film.figure.canvas.draw()
        ax = film.figure.axes[0]
        clock = ax.texts[0].get_window_extent()
        assert clock.y1 <= film.figure.bbox.y1
        assert not (ax.get_title() and clock.overlaps(ax.title.get_window_extent()))
    wide = films(
        iv.Problem(lambda t, y: [1], (0, 2), [-2.0], name="A wide film").solve(), lambda t, y: [[y[0], t], [2, t]]
    )
    wide.figure.canvas.draw()
    assert wide.figure.axes[0].title.get_window_extent().y1 <= wide.figure.bbox.y1


def test_numbers_of_a_thin_axis_in_space_do_not_run_together(films):
    sol = iv.ode45(lambda t, y: [1, 1e-6, 1], (0, 1), [0.0, 0.0, 0.0])
    ax = films(sol, [0, 1, 2]).figure.axes[0]
    for axis, most in ((ax.xaxis, 6), (ax.yaxis, 3), (ax.zaxis, 6)):
        low, high = axis.get_view_interval()
        assert sum(low <= place <= high for place in axis.get_majorticklocs()) <= most


def test_a_notebook_shows_a_film_once_and_small(films):
    """The film's figure is closed, so that it is not a picture too; 20 frames take less than 250 kB."""
    film = films(turning(), hand, links=[(0, 1)], trace=[1], duration=1, fps=20)
    assert film.figure.number in plt.get_fignums()
    page = film._repr_html_()
    assert film.figure.number not in plt.get_fignums()
    assert len(film.times) == 20
    assert len(page) < 2.5e5


@pytest.mark.parametrize("photograph", [False, True])
def test_frames_on_a_page_look_like_the_figure(films, photograph):
    """A palette is used only where nobody sees it: a photograph keeps its colours."""
    ax = plt.figure().add_subplot()
    if photograph:
        ax.imshow(np.random.default_rng(1).random((80, 80, 3)), extent=(-1, 1, -1, 1))
    film = films(turning(), hand, duration=0.1, ax=ax)
    frames = re.findall(r"data:image/png;base64,([^\"]*)", film.to_jshtml())
    last = Image.open(io.BytesIO(base64.b64decode(frames[-1].replace("\\\n", ""))))
    assert (last.mode == "P") != photograph
    film.show(len(film.times) - 1)
    drawn = io.BytesIO()
    film.figure.savefig(drawn, format="png", dpi=film.figure.dpi)
    expected = np.asarray(Image.open(drawn).convert("RGB"), dtype=float)
    assert abs(np.asarray(last.convert("RGB"), dtype=float) - expected).mean() < 0.5
