//! The byte layout of `InertiaEstimate`, as a reader in another language finds it in shared memory.
// Reading a struct's bytes needs unsafe code.
#![allow(missing_docs, unsafe_code)]

use proprio_topics::{Header, InertiaEstimate, LinkInertia, MAX_LINKS, Name, Nanos, SensorOffset};

fn bytes_of(estimate: &InertiaEstimate) -> &[u8] {
    // SAFETY: `repr(C)` without padding (its size is the sum of its fields' sizes, asserted beside
    // it), so that every byte is initialised; borrowed as long as the estimate.
    unsafe {
        std::slice::from_raw_parts(
            std::ptr::from_ref(estimate).cast(),
            size_of::<InertiaEstimate>(),
        )
    }
}

#[test]
fn an_inertia_has_its_bytes_where_the_contract_says() {
    let mut estimate = Box::new(InertiaEstimate {
        header: Header {
            epoch: 0x0102_0304_0506_0708,
            sequence: 9,
            acquired: Nanos(1_500_000_000),
            published: Nanos(2_500_000_000),
            ..Header::default()
        },
        link_count: 2,
        offset_count: 1,
        ..InertiaEstimate::default()
    });
    estimate.links[1] = LinkInertia {
        name: Name::new("l_hand").unwrap_or(Name::EMPTY),
        parameters: std::array::from_fn(|i| 1.0 + i as f64),
        standard_deviation: std::array::from_fn(|i| 101.0 + i as f64),
        motion: 12.5,
        rows: 7500,
        group: 3,
        accepted: 1,
    };
    estimate.offsets[0] = SensorOffset {
        name: Name::new("l_arm_ft_sensor").unwrap_or(Name::EMPTY),
        force: [6.0, -4.0, 11.0],
        torque: [0.2, -0.35, 0.1],
        standard_deviation: [0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
        group: 3,
        accepted: 1,
    };
    let bytes = bytes_of(&estimate);
    assert_eq!(bytes.len(), 37_184);
    let word = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight"));
    let half = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four"));
    let real = |at: usize| f64::from_bits(word(at));
    let text = |at: usize| {
        std::str::from_utf8(&bytes[at..at + 64]).map(|text| text.trim_end_matches('\0'))
    };

    assert_eq!(
        (word(0), word(8), word(16), word(24)),
        (0x0102_0304_0506_0708, 9, 1_500_000_000, 2_500_000_000)
    );
    assert_eq!((half(56), half(60)), (2, 1));
    // The second link.
    let link = 64 + 248;
    assert_eq!(text(link), Ok("l_hand"));
    for i in 0..10 {
        let (value, deviation) = (real(link + 64 + 8 * i), real(link + 144 + 8 * i));
        assert_eq!((value, deviation), (1.0 + i as f64, 101.0 + i as f64));
    }
    assert_eq!((real(link + 224), word(link + 232)), (12.5, 7500));
    assert_eq!((half(link + 240), half(link + 244)), (3, 1));
    // The first sensor, behind all links.
    let sensor = 64 + 248 * 128;
    assert_eq!(MAX_LINKS, 128);
    assert_eq!(text(sensor), Ok("l_arm_ft_sensor"));
    let numbers: Vec<f64> = (0..12).map(|i| real(sensor + 64 + 8 * i)).collect();
    assert_eq!(
        numbers,
        [
            6.0, -4.0, 11.0, 0.2, -0.35, 0.1, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6
        ]
    );
    assert_eq!((half(sensor + 160), half(sensor + 164)), (3, 1));
    // An entry that is not set holds NaN, not zero.
    assert!(real(64 + 64).is_nan() && half(64 + 244) == 0);
}
