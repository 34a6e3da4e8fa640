"""COLMAP models against pycolmap where it is installed, and against themselves; and damaged files."""

import numpy as np
import pytest

from vojax.datasets._colmap import ColmapImage, ColmapModel, read_colmap, write_colmap


def model(name="SIMPLE_RADIAL", parameters=(500.0, 320.5, 240.25, -0.05)):
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 4], [1, 1, 8], size=(5, 3))
    ids = np.array([2, 3, 7, 11, 12])
    images, tracks = [], [[] for _ in ids]
    for k in range(3):
        quaternion = np.array([1.0, *(0.05 * rng.normal(size=3))])
        pose = np.concatenate([quaternion / np.linalg.norm(quaternion), [0.3 * k, 0.1, -0.2]])
        seen = np.array([2, 3, -1, 7, 11, 12])[: 4 + k]
        for index, number in enumerate(seen):
            if number >= 0:
                tracks[list(ids).index(number)].append((k + 1, index))
        images.append(ColmapImage(k + 1, pose, 4, f"image {k}.png", rng.uniform(0, 480, size=(len(seen), 2)), seen))
    return ColmapModel(
        cameras={4: (name, 640, 480, np.array(parameters))},
        images=images,
        point_ids=ids,
        points=points,
        colors=rng.integers(0, 255, size=(5, 3)).astype(np.uint8),
        errors=rng.uniform(size=5),
        tracks=[np.array(track) for track in tracks],
    )


def check_equal(one, other):
    assert one.cameras.keys() == other.cameras.keys()
    for key, (name, width, height, parameters) in one.cameras.items():
        assert other.cameras[key][:3] == (name, width, height)
        np.testing.assert_array_equal(other.cameras[key][3], parameters)
    for a, b in zip(one.images, other.images, strict=True):
        assert (a.id, a.camera_id, a.name) == (b.id, b.camera_id, b.name)
        for field in ("cam_from_world", "pixels", "point_ids"):
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
    for field in ("point_ids", "points", "colors", "errors"):
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field))
    for a, b in zip(one.tracks, other.tracks, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
def test_what_is_written_comes_back(binary, tmp_path):
    check_equal(read_colmap(write_colmap(tmp_path / "model", model(), binary=binary)), model())


def test_the_bundle_is_in_our_conventions(tmp_path):
    bundle = model().bundle()
    assert bundle.free_intrinsics == ("focal", "k1")
    assert float(bundle.camera.cx[0]) == pytest.approx(320.0)
    assert float(bundle.camera.cy[0]) == pytest.approx(239.75)
    assert len(bundle.pixels) == 3 + 4 + 5
    np.testing.assert_allclose(bundle.pixels[0], model().images[0].pixels[0] - 0.5)
    # The third pixel of each image has no point.
    assert list(bundle.landmark_index[bundle.camera_index == 0]) == [0, 1, 2]
    assert list(bundle.camera_group) == [0, 0, 0]


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("SIMPLE_PINHOLE", (500.0, 320.5, 240.25)),
        ("PINHOLE", (500.0, 510.0, 320.5, 240.25)),
        ("SIMPLE_RADIAL", (500.0, 320.5, 240.25, -0.05)),
        ("RADIAL", (500.0, 320.5, 240.25, -0.05, 0.01)),
        ("OPENCV", (500.0, 510.0, 320.5, 240.25, -0.05, 0.01, 1e-3, -2e-3)),
    ],
)
def test_pycolmap_reads_what_we_write_and_projects_as_we_do(name, parameters, binary, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    ours = model(name, parameters)
    theirs = pycolmap.Reconstruction(str(write_colmap(tmp_path / "model", ours, binary=binary)))
    assert theirs.num_images() == 3
    assert theirs.num_points3D() == 5
    camera = theirs.cameras[4]
    bundle = ours.bundle()
    for image in ours.images:
        rigid = theirs.images[image.id].cam_from_world()
        points_cam = (rigid.rotation.matrix() @ ours.points.T).T + rigid.translation
        expected = np.array([camera.img_from_cam(point) for point in points_cam]).reshape(-1, 2)
        import vojax

        projected = bundle.camera.project(vojax.SE3(image.cam_from_world).apply(ours.points))
        np.testing.assert_allclose(np.asarray(projected) + 0.5, expected, atol=2e-3)
    # And back.
    theirs.write_binary(str(tmp_path / "model")) if binary else theirs.write_text(str(tmp_path / "model"))
    again = read_colmap(tmp_path / "model")
    np.testing.assert_allclose(again.points, ours.points, atol=1e-12)
    for a, b in zip(again.images, ours.images, strict=True):
        np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, atol=1e-12)
        np.testing.assert_array_equal(a.point_ids, b.point_ids)


def test_an_updated_model_keeps_what_it_is_not_about(tmp_path):
    before = model()
    bundle = before.bundle()
    after = before.updated(bundle.cam_from_world + 0.0, bundle.landmarks + 1.0, bundle.camera)
    np.testing.assert_allclose(after.points, before.points + 1.0)
    np.testing.assert_allclose(after.cameras[4][3], before.cameras[4][3], rtol=1e-6)
    assert [image.name for image in after.images] == [image.name for image in before.images]
    assert np.all(after.errors > 0)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_truncated_binary_files_are_refused(name, tmp_path):
    write_colmap(tmp_path, model())
    file = tmp_path / f"{name}.bin"
    file.write_bytes(file.read_bytes()[:-3])
    with pytest.raises(ValueError, match=rf"{name}\.bin is truncated: it ends at byte \d+"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("cameras", lambda t: t.replace("500.0", "abc"), r"cameras\.txt, line 2: malformed, expected CAMERA_ID"),
        ("cameras", lambda t: t.replace(" -0.05", ""), r"cameras\.txt, line 2: malformed"),
        ("images", lambda t: "\n".join(t.splitlines()[:3]), r"images\.txt ends at line 3"),
        ("images", lambda t: t.replace(" 2 ", " ", 1), r"images\.txt, line \d+: malformed"),
        ("points3D", lambda t: t.replace("7 ", "7.5 ", 1), r"points3D\.txt, line \d+: malformed"),
    ],
)
def test_malformed_text_files_are_refused_with_the_line(name, change, message, tmp_path):
    write_colmap(tmp_path, model(), binary=False)
    file = tmp_path / f"{name}.txt"
    file.write_text(change(file.read_text()))
    with pytest.raises(ValueError, match=message):
        read_colmap(tmp_path)


def test_models_that_cannot_be_adjusted_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"cameras\.txt not found"):
        read_colmap(tmp_path)
    with pytest.raises(ValueError, match="of the models FOV: expected one of"):
        model("FOV", (1.0, 2.0, 3.0, 4.0, 5.0)).bundle()
