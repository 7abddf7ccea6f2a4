//! Binary logs of Vector (.blf): objects, containers, and damage.

use super::{
    BLF_START, Read, blf, bus_error, classic, container, fd, frames, numbered, object, padded,
    read, stamps,
};
use proprio_drivers::{Frame, Id};
use proprio_gateway::log::{FrameDirection, LineError};

/// CAN_FD_MESSAGE_64 with `length` bytes stated and `data` present.
fn fd_64(flags: u32, code: u8, length: u8, more: u8, data: &[u8]) -> Vec<u8> {
    let mut body = vec![3, code, length, 0];
    body.extend((0x1234_5678_u32 | 0x8000_0000).to_le_bytes());
    body.extend([0; 4]);
    body.extend(flags.to_le_bytes());
    body.extend([0; 18]);
    body.extend([1, more, 0, 0, 0, 0]);
    assert_eq!(body.len(), 40);
    body.extend(data);
    padded(object(101, 1, 2, 7, &body))
}

#[test]
fn every_object_of_vector_with_a_frame_is_read() {
    let eight = [1, 2, 3, 4, 5, 6, 7, 8];
    let short = |id: u32, flags: u8, length: u8| {
        let mut body = vec![2, 0, flags, length];
        body.extend(id.to_le_bytes());
        body.extend(eight);
        body
    };
    let fd_100 = |flags: u8, code: u8, fd: u8, data: &[u8]| {
        let mut body = vec![2, 0, flags, code, 0x23, 1, 0, 0];
        body.extend([0, 0, 0, 0, 0, fd, data.len() as u8, 0, 0, 0, 0, 0]);
        body.extend(data);
        padded(object(100, 1, 2, 5, &body))
    };
    let id = Id::extended(0x1234_5678);
    let standard = Id::standard(0x123);
    let mut zeros = [0; 12];
    zeros[..8].copy_from_slice(&eight);
    let error = |kind: u32, channel: &[u8]| {
        let mut body = channel.to_vec();
        body.resize(60, 0xAA);
        padded(object(kind, 1, 2, 9, &body))
    };
    let cases = [
        // Time in units of 10 us; both versions of the header; a code above 8.
        (
            object(1, 1, 1, 150, &short(0x123, 1, 8)),
            classic(0x123, &eight),
            1_500_000,
        ),
        (
            object(86, 2, 2, 150, &short(0x123, 0, 15)),
            classic(0x123, &eight),
            150,
        ),
        (
            object(1, 2, 1, -3, &short(0x123, 0, 3)),
            classic(0x123, &eight[..3]),
            -30_000,
        ),
        (
            object(1, 1, 2, 1, &short(0x9234_5678, 0, 0)),
            Frame::new(id, &[]),
            1,
        ),
        (
            object(1, 1, 2, 1, &short(0x123, 0x80, 5)),
            Frame::remote(standard, 5),
            1,
        ),
        (
            fd_100(0, 9, 7, &[9; 12]),
            fd(standard, true, true, &[9; 12]),
            5,
        ),
        (fd_100(0, 1, 1, &[9]), fd(standard, false, false, &[9]), 5),
        (fd_100(0, 8, 0, &[9; 8]), classic(0x123, &[9; 8]), 5),
        (fd_100(0x80, 3, 0, &[]), Frame::remote(standard, 3), 5),
        (
            fd_64(0x3000, 9, 12, 0, &[9; 12]),
            fd(id, true, false, &[9; 12]),
            7,
        ),
        (fd_64(0x5000, 1, 1, 0, &[9]), fd(id, false, true, &[9]), 7),
        (fd_64(0, 2, 2, 0, &[9, 8]), Frame::new(id, &[9, 8]), 7),
        (fd_64(0x10, 2, 0, 0, &[]), Frame::remote(id, 2), 7),
        // Fewer bytes than stated, at the end of the object and before what follows the data.
        (
            fd_64(0x1000, 9, 12, 0, &eight),
            fd(id, false, false, &zeros),
            7,
        ),
        (
            fd_64(0x1000, 9, 12, 80, &[&eight[..], &[0xEE; 20]].concat()),
            fd(id, false, false, &zeros),
            7,
        ),
        (error(2, &[1, 0]), bus_error(), 9),
        (error(73, &[1, 0]), bus_error(), 9),
        (error(104, &[1]), bus_error(), 9),
    ];
    for (object, frame, t) in &cases {
        for file in [
            blf(&[&container(2, &padded(object.clone()))]),
            blf(&[&container(0, object)]),
            // Outside any container.
            blf(&[&padded(object.clone())]),
        ] {
            let found = read(&file);
            assert_eq!(found.report.bad, 0, "{frame:?}: {:?}", found.report);
            assert_eq!(frames(&found), [*frame]);
            assert_eq!(stamps(&found), [BLF_START + t], "{frame:?}");
        }
    }
    let objects: Vec<Vec<u8>> = cases
        .iter()
        .map(|(object, ..)| padded(object.clone()))
        .collect();
    let found = read(&blf(&[&container(2, &objects.concat())]));
    let expected: Vec<Frame> = cases.iter().map(|(_, frame, _)| *frame).collect();
    assert_eq!((frames(&found), found.report.bad), (expected, 0));
    let interfaces: Vec<&str> = found.entries.iter().map(|e| e.interface.as_str()).collect();
    assert_eq!(
        (interfaces[0], interfaces[10], interfaces[17]),
        ("can1", "can2", "can0")
    );
    let (r, t) = (Some(FrameDirection::Received), Some(FrameDirection::Sent));
    let directions: Vec<_> = found.entries.iter().map(|e| e.direction).collect();
    assert_eq!((directions[0], directions[1], directions[9]), (t, r, t));
    // Without a start.
    let mut file = blf(&[&container(2, &numbered(3))]);
    file[40..56].fill(0);
    assert_eq!(stamps(&read(&file)), [3]);
}

#[test]
fn objects_lie_over_containers_as_they_like() {
    // Frames between objects of other types, one of which is long; whatever the sizes of the
    // containers, down to one byte.
    let other = |size: usize| padded(object(65, 1, 2, 0, &vec![b'L'; size]));
    for (size, count) in [
        (1, 4),
        (7, 15),
        (100, 60),
        (4_096, 60),
        (65_536, 60),
        (1 << 20, 60),
    ] {
        let mut contents = Vec::new();
        for number in 0..count {
            contents.extend(numbered(number));
            contents.extend(other(usize::from(number) * 11));
        }
        contents.extend(other(usize::from(count) * 1_500));
        contents.extend(numbered(count));
        let pieces = contents.chunks(size).zip([0, 2].into_iter().cycle());
        let pieces: Vec<Vec<u8>> = pieces
            .map(|(piece, packing)| container(packing, piece))
            .collect();
        let found = read(&blf(&[&pieces.concat()]));
        assert_eq!(found.report.bad, 0, "{size}: {:?}", found.report);
        let numbers: Vec<u8> = found.entries.iter().map(|e| e.frame.data()[0]).collect();
        assert_eq!(numbers, (0..=count).collect::<Vec<u8>>(), "{size}");
    }
}

#[test]
fn damage_to_a_binary_log_costs_what_it_hits() {
    let many = |numbers: std::ops::Range<u8>| numbers.flat_map(numbered).collect::<Vec<u8>>();
    let [first, second, third] = [many(0..40), many(40..80), many(80..120)];
    let numbers = |found: &Read| {
        found
            .entries
            .iter()
            .map(|e| e.frame.data()[0])
            .collect::<Vec<u8>>()
    };
    let [before, after] = [(0..40).collect::<Vec<u8>>(), (80..120).collect()];
    let packed = [&first, &second, &third].map(|part| container(2, part));
    let error = |found: &Read| {
        found
            .report
            .first_bad
            .iter()
            .map(|b| b.1)
            .collect::<Vec<_>>()
    };

    // The packed bytes, of which the beginning may still be good.
    let mut damaged = packed[1].clone();
    let middle = damaged.len() / 2;
    damaged[middle..middle + 8].fill(0xFF);
    let found = read(&blf(&[&packed[0], &damaged, &packed[2]]));
    assert_eq!(error(&found), [LineError::Container]);
    assert!(numbers(&found).starts_with(&before) && numbers(&found).ends_with(&after));
    assert!(found.entries.len() < 120);

    // A container that is not what it says.
    let mut unknown = packed[1].clone();
    unknown[16] = 7;
    let found = read(&blf(&[&packed[0], &unknown, &packed[2]]));
    assert_eq!(error(&found), [LineError::Packing(7)]);
    assert_eq!(numbers(&found), [before.clone(), after.clone()].concat());
    let mut tiny = packed[1].clone();
    tiny[8..12].copy_from_slice(&5_u32.to_le_bytes());
    let found = read(&blf(&[&packed[0], &tiny, &packed[2]]));
    assert_eq!(error(&found), [LineError::Object]);
    assert_eq!(numbers(&found), [before.clone(), after.clone()].concat());

    // Noise between containers and between objects.
    let noise = [0xAA; 100];
    let found = read(&blf(&[&packed[0], &noise, &packed[1], &packed[2]]));
    // Padding may count.
    assert!(
        matches!(error(&found)[..], [LineError::Gap(100..=103)]),
        "{:?}",
        error(&found)
    );
    assert_eq!(numbers(&found), (0..120).collect::<Vec<u8>>());
    let found = read(&blf(&[&container(
        2,
        &[&first[..], &noise, &third].concat(),
    )]));
    // Padding may count.
    assert!(
        matches!(error(&found)[..], [LineError::Gap(100..=103)]),
        "{:?}",
        error(&found)
    );
    assert_eq!(numbers(&found), [before.clone(), after.clone()].concat());

    // An object whose size is wrong, or which is too short for a frame.
    let mut wrong = second.clone();
    wrong[8..12].copy_from_slice(&5_u32.to_le_bytes());
    let found = read(&blf(&[&container(
        0,
        &[&first[..], &wrong, &third].concat(),
    )]));
    assert_eq!(error(&found), [LineError::Object]);
    assert_eq!(found.entries.len(), 119);
    let short = object(86, 1, 2, 0, &[1, 0, 0, 8, 1, 0, 0, 0, 1, 2, 3, 4]);
    let found = read(&blf(&[&container(
        0,
        &[&first[..], &short, &third].concat(),
    )]));
    assert_eq!(error(&found), [LineError::Object]);
    assert_eq!(numbers(&found), [before.clone(), after.clone()].concat());
    let mut range = numbered(1);
    range[32 + 6] = 1;
    let found = read(&blf(&[&container(0, &range)]));
    let out = LineError::IdentifierRange {
        id: 0x1_0001,
        bits: 11,
    };
    assert_eq!(error(&found), [out]);
    assert!(
        found.why_empty.contains("object 1: the identifier"),
        "{}",
        found.why_empty
    );

    // A container that ends in the middle of its last object, at the end of the file.
    let begun = &first[..first.len() - 20];
    let found = read(&blf(&[&container(2, begun)]));
    let expected = (vec![LineError::CutOff], 39);
    assert_eq!((error(&found), found.entries.len()), expected);

    // A container that cannot be unpacked at all: a block of a kind that zlib does not have.
    let mut broken = packed[1].clone();
    broken[34] = 0xFF;
    let found = read(&blf(&[&packed[0], &broken, &packed[2]]));
    assert_eq!(error(&found), [LineError::Container]);
    assert_eq!(numbers(&found), [before, after].concat());

    // The file's header states more than there is.
    let mut file = blf(&[&packed[0]]);
    file[16] += 1;
    let found = read(&file);
    assert_eq!(
        (error(&found), found.entries.len()),
        (vec![LineError::CutOff], 40)
    );
}
