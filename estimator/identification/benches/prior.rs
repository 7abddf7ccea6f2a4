//! Time of a fit under a prior, by the number of links.
//!
//! `taskset -c 1 cargo bench -p proprio-identification --bench prior`
//!
//! Data: the information in the base wrench of a chain of revolute joints, with all base parameters
//! known to between 1e-4 and 1e-2. The bodies differ from CAD by a fifth.

use divan::{Bencher, black_box};
use nalgebra::{DMatrix, DVector};
use proprio_dynamics::model::Model;
use proprio_dynamics::regressor::identifiable::{
    Identifiable, Measurement, Offsets, Regime, Scope,
};
use proprio_identification::prior::{Posterior, Prior};

fn main() {
    divan::main();
}

struct Case {
    prior: Prior,
    links: Vec<usize>,
    data: DMatrix<f64>,
    right: DVector<f64>,
}

/// A chain of `count` links. `d` is CAD's parameters times -0.2 to 0.2.
fn case(count: usize) -> Case {
    let mut text = String::from("<robot name=\"chain\">");
    for link in 0..count {
        text += &format!(
            "<link name=\"link{link}\"><inertial><origin xyz=\"0.02 0.01 0.1\"/>\
             <mass value=\"1.5\"/><inertia ixx=\"0.006\" ixy=\"0.001\" ixz=\"0\" iyy=\"0.005\" \
             iyz=\"0\" izz=\"0.004\"/></inertial></link>"
        );
        if link > 0 {
            let (axis, parent) = (["1 0 0", "0 1 0", "0 0 1"][link % 3], link - 1);
            text += &format!(
                "<joint name=\"joint{link}\" type=\"continuous\"><parent link=\"link{parent}\"/>\
                 <child link=\"link{link}\"/><origin xyz=\"0.02 0.05 0.2\"/>\
                 <axis xyz=\"{axis}\"/></joint>"
            );
        }
    }
    let model = Model::from_urdf(&(text + "</robot>"), &[]).expect("a chain");
    let identifiable = Identifiable::new(
        &model,
        Scope::Tree,
        &Regime::free(&model),
        Measurement::Wrench,
        Offsets::Known,
    )
    .expect("a basis");
    let data = identifiable.basis().transpose();
    let data = DMatrix::from_fn(data.nrows(), data.ncols(), |row, column| {
        data[(row, column)] * [1e4, 1e3, 1e2][row % 3]
    });
    let mut difference = DVector::zeros(10 * count);
    for (link, body) in model.inertias().iter().enumerate() {
        let factor = 0.2 * ((link % 5) as f64 / 2.0 - 1.0);
        for (index, value) in body.parameters().iter().enumerate() {
            difference[10 * link + index] = factor * value;
        }
    }
    Case {
        prior: Prior::new(model.inertias()).expect("finite"),
        links: (0..count).collect(),
        right: &data * difference,
        data,
    }
}

#[divan::bench(args = [5, 12, 39])]
fn fit(bencher: Bencher<'_, '_>, count: usize) {
    let case = case(count);
    bencher.bench_local(|| {
        let posterior = Posterior::new(
            &case.prior,
            &case.links,
            black_box(&case.data),
            &case.right,
            &[],
        );
        posterior.expect("data").fit(0.5).expect("a fit")
    });
}

#[divan::bench(args = [5, 12, 39])]
fn weigh(bencher: Bencher<'_, '_>, count: usize) {
    let case = case(count);
    bencher.bench_local(|| {
        let posterior = Posterior::new(
            &case.prior,
            &case.links,
            black_box(&case.data),
            &case.right,
            &[],
        );
        posterior.expect("data").maximise_evidence().expect("a fit")
    });
}
