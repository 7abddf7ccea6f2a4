/* The reader of a robot's torques, contacts and measurements. A control loop calls proprio_update
 * once in each cycle and reads values after it: no system call, no lock, no allocation.
 *
 * Made from ffi/src/lib.rs; a test says when it is old. C++: proprio.hpp. */

#ifndef PROPRIO_H
#define PROPRIO_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/**
 * The kind of a channel: a joint's encoder. Read it with proprio_read_joint.
 */
#define PROPRIO_KIND_JOINT 0

/**
 * The kind of a channel: a force/torque sensor. Read it with proprio_read_wrench.
 */
#define PROPRIO_KIND_WRENCH 1

/**
 * The kind of a channel: an inertial measurement unit. Read it with proprio_read_imu.
 */
#define PROPRIO_KIND_IMU 2

/**
 * A bit of `quality`: at least one reading was lost between this one and the one before.
 */
#define PROPRIO_QUALITY_GAP_BEFORE 1

/**
 * A bit of `quality`: the device has its own sequence numbers.
 */
#define PROPRIO_QUALITY_DEVICE_COUNTER 32

/**
 * A bit of `quality`: the drive reports a fault that does not concern its encoder.
 */
#define PROPRIO_QUALITY_DRIVE_FAULT 64

/**
 * A bit of `quality`: the zero of the channel may have changed since the reading before.
 */
#define PROPRIO_QUALITY_ZERO_CHANGED 128

/**
 * The size of a name with its final zero byte.
 */
#define PROPRIO_NAME_SIZE 64

/**
 * Whether there is a value, and if not, why.
 */
typedef enum {
  /**
   * There is a value, and it may be used.
   */
  PROPRIO_OK = 0,
  /**
   * None has been received since this reader was made, or since its publisher was restarted.
   */
  PROPRIO_NEVER_SEEN = 1,
  /**
   * The last one is older than allowed.
   */
  PROPRIO_STALE = 2,
  /**
   * The publisher's description, with its names, has not been received yet.
   */
  PROPRIO_NOT_DESCRIBED = 3,
  /**
   * The publisher has nothing of that name and kind, or a pointer is null.
   */
  PROPRIO_UNKNOWN = 4,
  /**
   * It is withheld: see `reason`.
   */
  PROPRIO_WITHHELD = 5,
} proprio_status;

/**
 * Why a value is withheld.
 */
typedef enum {
  /**
   * It is not withheld.
   */
  PROPRIO_REASON_NONE = 0,
  /**
   * A channel it depends on has never been seen.
   */
  PROPRIO_REASON_NEVER_SEEN = 1,
  /**
   * A channel it depends on has been silent for longer than its maximum.
   */
  PROPRIO_REASON_STALE = 2,
  /**
   * A sensor it depends on is saturated.
   */
  PROPRIO_REASON_SATURATED = 3,
  /**
   * A device it depends on reports a fault.
   */
  PROPRIO_REASON_DEVICE_FAULT = 4,
  /**
   * The unknown contact wrenches of its sub-tree outnumber the equations.
   */
  PROPRIO_REASON_UNDETERMINED = 5,
  /**
   * Its predicted standard deviation exceeds the configured bound.
   */
  PROPRIO_REASON_UNCERTAIN = 6,
  /**
   * The result of the computation is not finite.
   */
  PROPRIO_REASON_NOT_FINITE = 7,
  /**
   * This contact is not present.
   */
  PROPRIO_REASON_ABSENT = 8,
  /**
   * A channel it depends on has too few samples yet for a velocity and an acceleration.
   */
  PROPRIO_REASON_STARTING = 9,
  /**
   * It depends on the base motion, and no link is declared to stand still.
   */
  PROPRIO_REASON_NO_STANCE = 10,
  /**
   * Neither the model nor a possible contact explains the F/T readings of its sub-tree.
   */
  PROPRIO_REASON_UNEXPLAINED = 11,
  /**
   * A sensor it depends on repeats its readings instead of measuring.
   */
  PROPRIO_REASON_FROZEN = 12,
  /**
   * A reading it depends on contradicts the ones before it.
   */
  PROPRIO_REASON_IMPLAUSIBLE = 13,
  /**
   * The readings contradict what is configured, such as an encoder reversed or a sensor turned.
   */
  PROPRIO_REASON_CONTRADICTED = 14,
} proprio_reason;

/**
 * Whether a gateway or an estimator is there.
 */
typedef enum {
  /**
   * None has been started, or all have ended and nobody holds what they left.
   */
  PROPRIO_NOT_STARTED = 0,
  /**
   * It sends its health ten times a second.
   */
  PROPRIO_RUNNING = 1,
  /**
   * It lives, but has sent no health for a second.
   */
  PROPRIO_STUCK = 2,
  /**
   * It has ended in order, or had gone before anybody looked.
   */
  PROPRIO_ENDED = 3,
  /**
   * It was killed, or has crashed.
   */
  PROPRIO_KILLED = 4,
} proprio_presence;

/**
 * The newest state of one robot. Only one thread may use it at a time.
 */
typedef struct proprio_reader proprio_reader;

/**
 * A joint's torque, in one reader. It stays good as long as the reader, whatever is restarted; in
 * another reader it may mean another joint.
 */
typedef struct {
  /**
   * Its number.
   */
  uint32_t number;
} proprio_torque_handle;

/**
 * A contact's wrench, in one reader. It stays good as long as the reader.
 */
typedef struct {
  /**
   * Its number.
   */
  uint32_t number;
} proprio_contact_handle;

/**
 * A channel of the gateway, in one reader. It stays good as long as the reader.
 */
typedef struct {
  /**
   * Its number.
   */
  uint32_t number;
} proprio_channel_handle;

/**
 * The torque of a joint, by the parent link on the child link along the URDF axis.
 */
typedef struct {
  /**
   * Torque [Nm] (force [N] for a prismatic joint). NaN if there is none.
   */
  double torque;
  /**
   * Its standard deviation [Nm]; NaN where it is not known.
   */
  double standard_deviation;
  /**
   * CLOCK_MONOTONIC [ns] at which it was measured: the same for as long as nothing new comes.
   */
  int64_t acquired;
  /**
   * How old it was at the last update [ns].
   */
  int64_t age;
} proprio_torque;

/**
 * Why there is no value.
 */
typedef struct {
  /**
   * PROPRIO_OK if there is a value.
   */
  proprio_status status;
  /**
   * Only with PROPRIO_WITHHELD.
   */
  proprio_reason reason;
  /**
   * How old the last value is [ns]; 0 if there is none or its age is not the reason.
   */
  int64_t age;
  /**
   * The channel that is the cause; empty if there is no single one.
   */
  char channel[PROPRIO_NAME_SIZE];
} proprio_unavailable;

/**
 * The wrench of a contact, by the environment on the link.
 */
typedef struct {
  /**
   * Force [N], in the axes of the frame that the estimator's configuration names.
   */
  double force[3];
  /**
   * Torque [Nm], in the same axes, about the frame's origin.
   */
  double torque[3];
  /**
   * Standard deviations of force [N] and torque [Nm]; NaN where not known.
   */
  double standard_deviation[6];
  /**
   * Where it is taken to act [m], in the same axes, from the same origin.
   */
  double position[3];
  /**
   * CLOCK_MONOTONIC [ns] at which it was measured: the same for as long as nothing new comes.
   */
  int64_t acquired;
  /**
   * How old it was at the last update [ns].
   */
  int64_t age;
  /**
   * Whether it was not declared, but F/T readings show that it is present.
   */
  bool is_detected;
  /**
   * Whether a declaration or a skin says where it is; else it is the configured place.
   */
  bool is_located;
} proprio_contact;

/**
 * What a joint's device reports, positive along the axis that the configuration states. NaN where
 * it does not report it.
 */
typedef struct {
  /**
   * Position [rad, or m].
   */
  double position;
  /**
   * Velocity [rad/s, or m/s].
   */
  double velocity;
  /**
   * Acceleration [rad/s^2, or m/s^2].
   */
  double acceleration;
  /**
   * Measured torque [Nm, or N].
   */
  double torque;
  /**
   * Motor current [A].
   */
  double current;
  /**
   * CLOCK_MONOTONIC [ns] at which it was measured: the same for as long as nothing new comes.
   */
  int64_t acquired;
  /**
   * How old it was at the last update [ns].
   */
  int64_t age;
  /**
   * Bits PROPRIO_QUALITY_...; none of them makes it unusable.
   */
  uint32_t quality;
} proprio_joint_state;

/**
 * What a force/torque sensor reports, in its own axes about its own origin.
 */
typedef struct {
  /**
   * Force [N].
   */
  double force[3];
  /**
   * Torque [Nm]; NaN if the sensor measures none.
   */
  double torque[3];
  /**
   * CLOCK_MONOTONIC [ns] at which it was measured: the same for as long as nothing new comes.
   */
  int64_t acquired;
  /**
   * How old it was at the last update [ns].
   */
  int64_t age;
  /**
   * Bits PROPRIO_QUALITY_...; none of them makes it unusable.
   */
  uint32_t quality;
} proprio_wrench;

/**
 * What an inertial measurement unit reports, in its own axes. NaN where it does not report it.
 */
typedef struct {
  /**
   * Acceleration minus gravity [m/s^2]: it points up at rest.
   */
  double proper_acceleration[3];
  /**
   * Angular velocity [rad/s].
   */
  double angular_velocity[3];
  /**
   * Angular acceleration [rad/s^2].
   */
  double angular_acceleration[3];
  /**
   * Magnetic field [T].
   */
  double magnetic_field[3];
  /**
   * Unit quaternion w, x, y, z: world from IMU, by the device's own filter.
   */
  double orientation[4];
  /**
   * CLOCK_MONOTONIC [ns] at which it was measured: the same for as long as nothing new comes.
   */
  int64_t acquired;
  /**
   * How old it was at the last update [ns].
   */
  int64_t age;
  /**
   * Bits PROPRIO_QUALITY_...; none of them makes it unusable.
   */
  uint32_t quality;
} proprio_imu;

/**
 * Who is missing.
 */
typedef struct {
  /**
   * The robot's gateway.
   */
  proprio_presence gateway;
  /**
   * The robot's estimator.
   */
  proprio_presence estimator;
  /**
   * Whether both are running, and nothing else is wrong.
   */
  bool is_nobody;
  /**
   * The same and what else is wrong, in words: what, where, and what to do.
   */
  char text[512];
} proprio_missing;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * CLOCK_MONOTONIC [ns], the clock of all instants here.
 */
int64_t proprio_now(void);

/**
 * A reader of `robot`, or NULL, and then why in `message` (of `message_size` bytes; may be NULL).
 *
 * Torques and contacts are stale after `max_age` [ns], measurements after their channel's maximum
 * silence. The reader belongs to a domain: the folder `runtime_dir` and the name `domain`; where
 * they are NULL, the environment names them (PROPRIO_RUNTIME_DIR, PROPRIO_DOMAIN), as for the
 * gateway and the estimator. They need not run yet. The reader has a thread that looks for them;
 * it takes no signals, and ends with proprio_reader_free. A process that forks makes its readers
 * after that.
 */
proprio_reader *proprio_reader_new(const char *robot,
                                   int64_t max_age,
                                   const char *runtime_dir,
                                   const char *domain,
                                   char *message,
                                   size_t message_size);

/**
 * Ends a reader. NULL is allowed. In a child of the process that made it, nothing happens.
 */
void proprio_reader_free(proprio_reader *reader);

/**
 * The torque of the joint `name`, which need not exist yet. Not for the cycle: it allocates.
 */
proprio_torque_handle proprio_find_torque(proprio_reader *reader, const char *name);

/**
 * The wrench of the contact `name`, which need not exist yet. Not for the cycle: it allocates.
 */
proprio_contact_handle proprio_find_contact(proprio_reader *reader, const char *name);

/**
 * The measurements of the joint or sensor `name`, of kind PROPRIO_KIND_...; it need not exist yet.
 * Not for the cycle: it allocates.
 */
proprio_channel_handle proprio_find_channel(proprio_reader *reader,
                                            uint32_t kind,
                                            const char *name);

/**
 * Takes what has arrived by `now` (proprio_now). Once in each cycle, before values are read. No
 * system call, no lock, no allocation. If `now` is of another clock, all is stale.
 */
void proprio_update(proprio_reader *reader, int64_t now);

/**
 * Waits until an estimate may have arrived since the last update, at most until `deadline`
 * (proprio_now). Returns whether one may have. One system call. A signal does not end it.
 */
bool proprio_wait_for_estimate(const proprio_reader *reader, int64_t deadline);

/**
 * As proprio_wait_for_estimate, for a sample of any channel.
 */
bool proprio_wait_for_sample(const proprio_reader *reader, int64_t deadline);

/**
 * The torque of a joint, as of the last update. `torque` and `why` may be NULL; both are
 * always written. For the cycle.
 */
proprio_status proprio_read_torque(const proprio_reader *reader,
                                   proprio_torque_handle joint,
                                   proprio_torque *torque,
                                   proprio_unavailable *why);

/**
 * The torques of `count` joints, as of the last update. For each joint in the order of `joints`:
 * its torque [Nm] (NaN if there is none), standard deviation [Nm] and status; and the instant that
 * they all refer to, CLOCK_MONOTONIC [ns] (0 if no torque has a value). Each array, and
 * `acquired`, may be NULL. Returns how many have a value. For the cycle.
 */
size_t proprio_read_torques(const proprio_reader *reader,
                            const proprio_torque_handle *joints,
                            size_t count,
                            double *torques,
                            double *standard_deviations,
                            proprio_status *statuses,
                            int64_t *acquired);

/**
 * The wrench of a contact: as proprio_read_torque.
 */
proprio_status proprio_read_contact(const proprio_reader *reader,
                                    proprio_contact_handle contact,
                                    proprio_contact *value,
                                    proprio_unavailable *why);

/**
 * The state of a joint as its device reports it: as proprio_read_torque.
 */
proprio_status proprio_read_joint(const proprio_reader *reader,
                                  proprio_channel_handle channel,
                                  proprio_joint_state *value,
                                  proprio_unavailable *why);

/**
 * A force/torque sensor's reading: as proprio_read_torque.
 */
proprio_status proprio_read_wrench(const proprio_reader *reader,
                                   proprio_channel_handle channel,
                                   proprio_wrench *value,
                                   proprio_unavailable *why);

/**
 * An inertial measurement unit's reading: as proprio_read_torque.
 */
proprio_status proprio_read_imu(const proprio_reader *reader,
                                proprio_channel_handle channel,
                                proprio_imu *value,
                                proprio_unavailable *why);

/**
 * The name of the estimator's joint `number`, from 0, in `name` of PROPRIO_NAME_SIZE bytes; false
 * if there is none, or if the estimator has not been seen yet.
 */
bool proprio_torque_name(const proprio_reader *reader, size_t number, char *name);

/**
 * The name of the estimator's contact `number`: as proprio_torque_name.
 */
bool proprio_contact_name(const proprio_reader *reader, size_t number, char *name);

/**
 * The name of the gateway's channel `number` and its kind (PROPRIO_KIND_..., or a greater number
 * for one that this library does not read): as proprio_torque_name.
 */
bool proprio_channel_name(const proprio_reader *reader, size_t number, char *name, uint32_t *kind);

/**
 * Who is missing. Not for the cycle: it takes a lock for a moment and allocates. Returns
 * `is_nobody`.
 */
bool proprio_who_is_missing(const proprio_reader *reader, proprio_missing *missing);

/**
 * `why` in words, as "withheld: saturated (l_arm_ft_sensor)", in `text` of `size` bytes; "there is
 * a value" if its status is PROPRIO_OK.
 */
void proprio_describe(const proprio_unavailable *why, char *text, size_t size);

/**
 * The version of this library, as "0.1.0".
 */
const char *proprio_version(void);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* PROPRIO_H */
