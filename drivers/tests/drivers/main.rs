//! Tests of every driver through its public interface: golden bytes from the protocol's documents,
//! decoding as the inverse of encoding, robustness against any frame, and bring-up against a board
//! that answers like a real one.

mod any_frame;
mod ati;
mod bringup;
mod canopen;
mod canopen_exchange;
mod canopen_file;
mod command;
mod controls;
mod cubemars;
mod damiao;
mod dbc;
mod every_device;
mod example;
mod findings;
mod golden;
mod icub_mc4;
mod jr3_and_optoforce;
mod moteus;
mod myactuator;
mod odrive;
mod openimu;
mod pairing;
mod recognise;
mod recognise_icub;
mod rig;
mod robotous_and_aidin;
mod robstride;
mod round_trip;
mod signals;
mod skin_and_mais;
mod traffic;
mod vesc;
mod xsens_mti;
