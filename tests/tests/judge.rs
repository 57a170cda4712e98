//! The judge against its dull twin, and what random views of a model are sent against its tolerance.

use lodestream_server::judge::calibration::{CalibrationOptions, calibrate, mesh_for_view};
use lodestream_server::judge::original::Original;
use lodestream_server::judge::random_views::random_view;
use lodestream_server::judge::screen_error::{Candidate, findings};
use lodestream_server::mesh::TriMesh;
use lodestream_server::pack::extract_complete;
use lodestream_tests::meshes;
use lodestream_tests::model::TestModel;
use lodestream_tests::screen_error::{Judged, judge};

#[test]
fn the_judge_agrees_with_trying_everything() {
    for (name, mesh) in
        [("sphere", meshes::colored_sphere(3)), ("genus", meshes::genus(2, 5)), ("grid", meshes::grid(20, 15))]
    {
        let test = TestModel::new(mesh, None);
        let complete = extract_complete(&test.model).expect("a sound pack");
        let original = Original::new(&complete);
        let (mut shown, mut hidden, mut off) = (0, 0, 0);
        for index in 0..12 {
            let mut view = random_view(&original, 3, index);
            view.tolerance_px *= 4.0;
            let (mesh, _) = mesh_for_view(&test.model, &view).expect("a sound pack");
            let found = findings(&original, &original.shown(&view), &Candidate::new(&mesh), &view);
            let mut found: Vec<Judged> = found
                .iter()
                .map(|f| Judged {
                    position: original.position(f.shown.vertex).to_array(),
                    pixels: f.pixels,
                    is_unoccluded: f.shown.is_unoccluded,
                })
                .collect();
            let mut expected = judge(&complete, &mesh, &view);
            let by_place = |a: &Judged, b: &Judged| a.position.partial_cmp(&b.position).expect("no NaN");
            found.sort_by(by_place);
            expected.sort_by(by_place);
            assert_eq!(found, expected, "{name}, view {index}");
            shown += found.iter().filter(|f| f.is_unoccluded).count();
            hidden += found.iter().filter(|f| !f.is_unoccluded).count();
            off += found.iter().filter(|f| f.pixels > 0.0).count();
        }
        assert!(
            shown > 100 && (off > 0 || name == "genus") && (hidden > 0 || name != "genus"),
            "{name}: {shown} shown, {hidden} hidden, {off} off"
        );
    }
}

/// The guarantee is a statistical one (TARGETS, row 22); a lasting breach of it is a bug.
#[test]
fn errors_keep_their_word() {
    keep_their_word("sphere", meshes::colored_sphere(5));
    keep_their_word("debris", meshes::debris(40, 3));
}

fn keep_their_word(name: &str, mesh: TriMesh) {
    let test = TestModel::new(mesh, None);
    let options = CalibrationOptions { views: 60, seed: 1, tolerance_px: None };
    let mut heard = Vec::new();
    let found = calibrate(&test.model, &options, &mut |done| heard.push(done)).expect("a sound pack");
    assert_eq!(heard, (0..=60).collect::<Vec<_>>());
    assert!(found.error.vertices > 1000 && found.error.max > 0.0, "{name}: {found:?}");
    assert!(found.error.p999 <= 1.0 && found.error.max <= 1.3, "{name}: {found:?}");
    assert_eq!(found.color.is_some(), test.model.info().has_colors, "{name}");
    assert_eq!(found, calibrate(&test.model, &options, &mut |_| {}).expect("a sound pack"), "{name} again");
}
