"""`slatprep check-alignment` draws what the store holds, of the assets that were meant."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from support import commands
from support.deformed import MOVES
from support.made_store import rewrite
from support.synthetic import QUARTER_TURN
from support.trees import tree

from slatprep import StoreError, apply_transform, open_store, voxel_centres
from slatprep.align.starts import euler_starts
from slatprep.geometry.frames import invert_transform, make_transform
from slatprep.inspect.check import AlignmentCheck, check_alignment, choose_assets
from slatprep.inspect.pictures import canvas
from slatprep.inspect.pictures.alignment import HEIGHT, PANEL, WIDTH, draw_alignment, panels
from slatprep.inspect.pictures.scene import FARTHEST, Scene, distance_colours, scene_of, views
from slatprep.inspect.pictures.viewer import cube_mesh, has_screen, meshes
from slatprep.inspect.pictures.voxels import View
from slatprep.inspect.pictures.write import write_pictures
from slatprep.records import Alignment, Candidate, Placement, Search
from slatprep.store.records import StoredRecords


def run(*words: object, code: int = 0) -> Result:
    return commands.run("check-alignment", *words, code=code)


def misplace(path: Path, shift: float) -> None:
    rewrite(path, "asset/transform", 0, QUARTER_TURN + shift * np.eye(4, k=3))


def of_ant(path: Path) -> tuple[Scene, AlignmentCheck, Alignment]:
    """Return what a picture of an asset is drawn of."""
    store = open_store(path)
    alignment = StoredRecords(store).of("ant").alignment
    return scene_of(store.asset("ant")), check_alignment(store, "ant"), alignment


@pytest.fixture
def sides(monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """Draw panels of few pixels; return the sides that are asked for."""
    asked: set[int] = set()

    def few_pixels(scene: Scene, side: int) -> tuple[View, ...]:
        asked.add(side)
        return views(scene, 80)

    monkeypatch.setattr("slatprep.inspect.pictures.alignment.views", few_pixels)
    return asked


def whole_texts(figure: Figure) -> list[str]:
    """Return all texts of a picture, none of which is cut or written over another."""
    renderer = figure.canvas.get_renderer()
    texts = [t for t in figure.findobj(Text) if t.get_text() and t.get_visible()]
    boxes = [text.get_window_extent(renderer) for text in texts]
    for k, box in enumerate(boxes):
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= WIDTH and box.y1 <= HEIGHT, texts[k]
        # Lines of a paragraph touch; what else shares a pixel cannot be read.
        for other in range(k):
            both = Bbox.intersection(box, boxes[other])
            assert both is None or both.height <= 4, (texts[k], texts[other])
    return [text.get_text() for text in texts]


# -- the picture ----------------------------------------------------------------


def hold_whole(picture: np.ndarray, *columns: int) -> None:
    """Hold that no part of a picture is blank: each of its rows, each column, what is beside."""
    width = WIDTH + (len(columns) - 5) * (PANEL + 14)
    assert picture.shape[:2] == (HEIGHT, width)
    for top in (142, 456, 770):
        for left in columns:
            assert picture[top : top + 300, left : left + 300, :3].std() > 0.05, (top, left)


def test_several_assets_get_a_file_each_and_a_contact_sheet(copy, tmp_path, monkeypatch):
    read: list[str] = []
    noted = "slatprep.inspect.pictures.write.scene_of"
    monkeypatch.setattr(noted, lambda asset: read.append(asset.asset_id) or scene_of(asset))
    folder, again = tmp_path / "pictures", tmp_path / "again"
    words = ("--worst", "1", "--asset", "cup", "--store", copy, "--picture")
    told = json.loads(run(*words, folder, "--json").stdout)["assets"]
    assert len(told) == 2 and told[0]["asset_id"] == "cup"
    assert sorted(read) == sorted(one["asset_id"] for one in told)  # Once, for the sheet as well.
    assert {Path(one["picture"]) for one in told} | {folder / "sheet.png"} == set(folder.iterdir())
    run(*words, again, "--jobs", "2")
    assert tree(again) == tree(folder)
    for asset in told:
        passes = {figure["name"]: figure["passes"] for figure in asset["figures"]}
        assert passes["confidence"] is True and passes["overlap"] is None
    sheet = imread(folder / "sheet.png")
    assert sheet[84:284, 40:240].std() > 0.05 and sheet[84:284, 680:880].std() > 0.05
    image = imread(folder / "cup.png")
    hold_whole(image, 48, 362, 676, 990, 1350)
    picture = open_store(copy)["cup"].plot()
    assert picture.format == "PNG"  # A notebook shows it.
    assert np.array_equal(np.asarray(picture)[..., :3], np.rint(image[..., :3] * 255))


@pytest.mark.usefixtures("sides")
def test_the_next_of_tied_placements_stands_beside_the_chosen_one(copy):
    one, check, alignment = of_ant(copy)
    check = replace(check, unusual=("values: soft",))
    turned = check.transform @ QUARTER_TURN
    ties = tuple(Placement(at, score, 9.0) for at, score in ((check.transform, 0.5), (turned, 0.7)))
    tied = replace(alignment, placements=ties, settled_by=None)
    with canvas.styled():
        figure = draw_alignment(one, check, "t", "s", tied)
        words = [text.get_text() for text in figure.findobj(Text)]
    assert {"placement that fits about as well", "unusual: values: soft"} <= set(words)
    assert figure.bbox.width == WIDTH + PANEL + 14
    scene = replace(one, tied=turned)
    drawn, alone = (panels(which, views(scene, 90)[0]) for which in (scene, one))
    assert list(drawn) == ["before", "after", "another", "result", "error"]
    assert np.abs(drawn.pop("another") - drawn["after"]).sum() > 9
    assert drawn.keys() == alone.keys()
    assert all(np.array_equal(drawn[name], alone[name]) for name in alone)


@pytest.mark.usefixtures("sides")
@pytest.mark.parametrize("tilt", [0, 40])
def test_the_nearest_start_is_marked_though_another_fits_better(copy, tilt):
    one, check, alignment = of_ant(copy)
    turn = euler_starts()[3]  # By 270 degrees about z.
    starts = tuple(Candidate(s.index, s.euler_degrees, 0.9, 0.5, s.same_as) for s in euler_starts())
    starts = (replace(starts[0], fitness=0.95), *starts[1:])
    tilted = Rotation.from_rotvec(np.radians(tilt) * np.ones(3) / np.sqrt(3)).as_matrix()
    there = make_transform(tilted @ turn.rotation)
    moved = replace(alignment, search=Search.EULER64, candidates=starts, transform=there)
    with canvas.styled():
        figure = draw_alignment(one, check, "t", "s", moved)
        axes = figure.axes[-1]
        (tick,) = axes.get_xticks()
        assert [text.get_text() for text in axes.get_xticklabels()] == [
            "nearest start: 0°, 0°, 270°"
        ]
    accent = to_rgba(canvas.ACCENT)
    marked = [k for k, bar in enumerate(axes.patches) if bar.get_facecolor() == accent]
    assert marked == [tick] and tick > 0


@pytest.mark.usefixtures("sides")
def test_no_words_are_cut_or_written_over_others(copy):
    for name, value in (("confidence", 0.4), ("expected_accuracy", 0.5), ("contradicted", True)):
        rewrite(copy, f"asset/{name}", 0, value)
    misplace(copy, 0.06)
    scene, check, alignment = of_ant(copy)
    for search in Search:
        with canvas.styled():
            figure = draw_alignment(scene, check, "t", "s", replace(alignment, search=search))
            whole = " ".join(whole_texts(figure))
        assert len(check.reasons) >= 4 and all(reason in whole for reason in check.reasons)
        (histogram,) = [axes for axes in figure.axes if axes.patches and axes.lines]
        before = np.histogram(np.minimum(scene.error_before, FARTHEST - 1e-9), 30, (0, FARTHEST))[0]
        assert histogram.get_ylim()[1] > before.max() / len(scene.error_before)


@pytest.mark.usefixtures("sides")
@pytest.mark.parametrize("count", [9, 60])
def test_the_names_of_many_classes_stay_on_the_picture(count, copy):
    one, check, alignment = of_ant(copy)
    many = replace(
        one,
        slat_material=(np.arange(len(one.slat)) % count).astype(np.uint8),
        before=one.before._replace(material=np.zeros(len(one.before.voxels), np.uint8)),
        labels=tuple(f"material {k}" for k in range(count)),
    )
    with canvas.styled():
        texts = whole_texts(draw_alignment(many, check, "t", "s", alignment))
    names = [text for text in texts if text.startswith("material ")]
    left = [text for text in texts if text.endswith(" more")]
    assert len(names) >= 8 and len(set(names)) == len(names)
    assert left == ([] if count == 9 else [f"and {count - len(names)} more"])
    assert count > 9 or len(names) == 9


@pytest.mark.parametrize("kind", ["svg", "pdf"])
def test_a_picture_for_a_paper_is_of_lines_and_letters(kind, copy, tmp_path, sides):
    files = [tmp_path / f"{name}.{kind}" for name in ("one", "two")]
    for file in files:
        run("--asset", "ant", "--store", copy, "--picture", file)
    assert sides == {2 * PANEL}
    assert files[0].read_bytes() == files[1].read_bytes()
    assert files[0].read_bytes()[:5] in (b"<?xml", b"%PDF-")


def test_a_wrong_transform_is_drawn_worse(copy):
    store = open_store(copy)
    scene = scene_of(store.asset("ant"))
    misplace(copy, 0.1)
    wrong = scene_of(open_store(copy).asset("ant"))
    assert scene.error.max() < 0.01
    assert wrong.error.mean() > 2
    for right, bad in zip(views(scene, 80), views(wrong, 80), strict=True):
        # The scale of distances goes from light to dark.
        ink_right, ink_bad = (1 - panels(s, v)["error"] for s, v in ((scene, right), (wrong, bad)))
        assert ink_bad.sum() > 1.5 * ink_right.sum()


def test_a_deformation_is_shown_before_and_after_and_as_displacement(deformed_build, tmp_path):
    store = open_store(deformed_build.store)
    for asset in store:
        scene = scene_of(asset)
        # The field as the SLAT's cells look it up: its outside lies on the SLAT's.
        lattice = cKDTree(asset.coords.astype(float))
        distance, _ = lattice.query(scene.deformed.voxels.astype(float))
        assert np.mean(distance <= 1.0) > 0.95
        material = asset.grid_material[tuple(scene.before.voxels.T)]
        assert set(np.unique(scene.deformed.material)) == set(np.unique(material))
        # Measured from the similarity: what the truth says, less what that takes of it.
        true_places = MOVES[asset.asset_id](voxel_centres(asset.coords))
        similar = apply_transform(invert_transform(asset.transform), voxel_centres(asset.coords))
        moved = np.linalg.norm(true_places - similar, axis=1) * 64
        assert np.median(np.abs(scene.displacement - moved)) < 0.7
        # Where the voxels truly lie they are as near to the surface as two lattices can be.
        surface = cKDTree(voxel_centres(scene.before.voxels))
        least, _ = surface.query(MOVES[asset.asset_id](voxel_centres(scene.surface)))
        assert np.median(scene.error) < 64 * np.median(least) + 0.1
        assert np.quantile(scene.error, 0.9) < 0.4 * np.quantile(scene.error_before, 0.9)
        for view in views(scene, 90):
            drawn = panels(scene, view)
            assert len(drawn) == 6 and drawn["error"].min() < 0.9
            for name, other in (("similarity", "before"), ("deformed", "similarity"),
                                ("displacement", "result")):  # fmt: skip
                assert np.abs(drawn[name] - drawn[other]).sum() > 9
        file = tmp_path / f"{asset.asset_id}.png"
        result = run("--asset", asset.asset_id, "--store", store.path, "--picture", file)
        assert "picture:" in result.stdout, result.output
        image = imread(file)
        hold_whole(image, 48, 362, 676, 990, 1304, 1618, 1978)
    # The scale under the column goes from the colour of none to that of the largest.
    bar = image[1092, 990:1290, :3]
    end = scene.displacement_scale
    np.testing.assert_allclose(bar[[0, -1]], distance_colours(np.array([0, end]), end), atol=0.01)
    assert end - 1 < scene.displacement.max() <= end


def test_the_error_is_the_distance_to_the_nearest_surface_voxel(copy):
    misplace(copy, 0.03)
    scene = scene_of(open_store(copy).asset("ant"))
    points = apply_transform(invert_transform(scene.after.transform), voxel_centres(scene.surface))
    here = voxel_centres(scene.before.voxels)
    some = slice(0, None, 40)
    expected = [np.linalg.norm(here - point, axis=1).min() * 64 for point in points[some]]
    np.testing.assert_allclose(scene.error[some], expected, atol=1e-9)
    colours = distance_colours(np.array([0.0, FARTHEST, 99.0]))
    np.testing.assert_array_equal(colours[1], colours[2])
    assert colours[0].sum() > colours[1].sum()


@pytest.mark.usefixtures("sides")
def test_a_place_that_cannot_be_written_is_named(copy, tmp_path):
    (tmp_path / "file").touch()
    words = ("--asset", "ant", "--store", copy, "--picture", tmp_path / "file" / "x")
    told = run(*words, code=1).stderr
    assert "cannot be written" in told and "--picture" in told


# -- which assets ---------------------------------------------------------------


def test_worst_and_ambiguous_choose_by_the_stores_figures(mixed_build, monkeypatch):
    store = open_store(str(mixed_build.store))
    assert store.ids == ["ant", "bear.front", "bear.side", "cup", "dog"]
    columns = {
        "verdict": np.array(["good"] * 5),
        "confidence": np.full(5, 0.9),
        "fitness": np.array([0.9, 0.5, 1.0, np.nan, 0.7]),
        "fitness_backward": np.array([0.3, 0.9, 1.0, 1.0, 0.6]),
        "ambiguity": np.array([0.0, 0.2, 0.9, 0.05, 0.01]),
    }
    monkeypatch.setattr(store, "column", columns.__getitem__)
    assert choose_assets(store, worst=3) == ["cup", "ant", "bear.front"]
    assert choose_assets(store, worst=99) == ["cup", "ant", "bear.front", "dog", "bear.side"]
    assert choose_assets(store, ambiguous=True) == ["bear.side", "bear.front"]
    chosen = choose_assets(store, ["dog", "ant"], worst=2, ambiguous=True)
    assert chosen == ["dog", "ant", "cup", "bear.side", "bear.front"]
    with pytest.raises(StoreError, match="no asset"):
        choose_assets(store, ["nobody"], worst=1)
    columns["confidence"] = np.array([0.99, 0.97, 0.2, 0.98, np.nan])
    columns["verdict"] = np.array(["good", "doubtful", "failed", "good", "good"])
    assert choose_assets(store, worst=5) == ["bear.side", "bear.front", "dog", "cup", "ant"]


def test_that_no_asset_is_chosen_is_no_failure(copy):
    rewrite(copy, "asset/ambiguity", slice(None), 0.0)
    assert "no asset is ambiguous" in run("--ambiguous", "--store", copy).stdout
    assert not copy.with_name("copy.pictures").exists()


@pytest.mark.usefixtures("sides")
def test_any_id_becomes_a_safe_file_name_of_its_own(copy, tmp_path):
    rewrite(copy, "asset/id", slice(2), np.array(["../ant", "sheet"], object))
    store, drawn = open_store(copy), tmp_path / "drawn"
    checks = [check_alignment(store, row) for row in (0, 1)]
    files, none = write_pictures(store, checks[:1], drawn)
    assert none is None and {*files} == {*drawn.iterdir()}
    files, sheet = write_pictures(store, checks, drawn)
    assert sheet is not None and {*files, sheet} == {*drawn.iterdir()}
    assert len({*files, sheet}) == 3


# -- the terminal ---------------------------------------------------------------


def test_numbers_stand_beside_their_thresholds(copy):
    told = run("--asset", "ant", "--store", copy, "--picture", "none").stdout
    rows = {line.split()[0]: line.split()[1:] for line in told.splitlines() if "  " in line}
    assert rows["confidence"][1:4] == [">=", "0.9", "yes"]
    assert rows["ambiguity"][1:4] == ["<=", "0.05", "yes"]
    share = r"(\d+\.\d)%"
    rests = (
        rf"confidence {share}: .* same object with a probability of {share}, .* right with {share};"
    )
    assert re.search(rests, told)
    assert "\x1b" not in told


@pytest.mark.usefixtures("sides")
def test_without_a_screen_show_says_where_the_picture_is(copy, tmp_path, monkeypatch):
    """Also of a broken store."""
    if sys.platform != "linux":
        pytest.skip("a screen is always taken to be there")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    file = tmp_path / "ant.PNG"
    told = run("--asset", "ant", "--store", copy, "--picture", file, "--show")
    assert "no screen" in told.stderr and str(file) in told.stderr
    assert f"picture: {file}" in told.stdout and imread(file, "png").size
    misplace(copy, 0.4)
    file = copy.with_name("copy.pictures") / "ant.png"
    assert str(file) in run("--asset", "ant", "--store", copy, "--show", code=1).stderr
    assert imread(file).shape[:2] == (HEIGHT, WIDTH)


def test_a_screen_is_known_by_its_variables():
    assert not has_screen({}, "linux")
    assert has_screen({"DISPLAY": ":0"}, "linux")
    assert has_screen({"WAYLAND_DISPLAY": "wayland-0"}, "linux")
    assert has_screen({}, "darwin")


# -- the viewer's meshes --------------------------------------------------------


def test_a_mesh_encloses_the_volume_of_its_voxels():
    voxels = np.argwhere(np.ones((2, 3, 4))).astype(np.uint8) + np.uint8(9)
    transform = QUARTER_TURN.copy()
    transform[:3, :3] *= 1.5
    vertices, triangles, colours = cube_mesh(voxels, np.full((24, 3), 0.5), transform)
    assert len(vertices) == len(colours) == 4 * 2 * (6 + 8 + 12)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    # The divergence theorem: positive, as the triangles turn outwards.
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(24 / 64**3 * 1.5**3)


def test_the_viewer_gets_four_parts_side_by_side(mixed_build):
    parts = meshes(scene_of(open_store(mixed_build.store).asset("ant")))
    middles = [vertices[:, 0].mean() for vertices, _, _ in parts]
    assert len(parts) == 4 and (np.diff(middles) > 0.8).all()
