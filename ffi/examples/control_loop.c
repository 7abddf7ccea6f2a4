/* An example control loop: reads the torques of all joints of a robot at 1 kHz and prints them once
 * a second, and who is missing. Ctrl-C ends it.
 *
 *     cc control_loop.c $(pkg-config --cflags --libs proprio) -o control_loop
 *     ./control_loop icub_left_arm
 */
#define _POSIX_C_SOURCE 200809L
#include <proprio.h>
#include <signal.h>
#include <stdio.h>
#include <time.h>

enum { MAX_JOINTS = 128 };

static volatile sig_atomic_t stop;

static void on_signal(int number) {
    (void)number;
    stop = 1;
}

int main(int count, char **words) {
    const char *robot = count > 1 ? words[1] : "icub_left_arm";
    signal(SIGINT, on_signal);
    signal(SIGTERM, on_signal);
    /* An estimate that is older than 50 ms is stale. The reader may start before the robot does. */
    char message[256];
    proprio_reader *reader =
        proprio_reader_new(robot, 50000000, NULL, NULL, message, sizeof message);
    if (reader == NULL) {
        fprintf(stderr, "control_loop: %s\n", message);
        return 1;
    }
    proprio_torque_handle joints[MAX_JOINTS];
    char names[MAX_JOINTS][PROPRIO_NAME_SIZE];
    size_t joint_count = 0;
    struct timespec next;
    clock_gettime(CLOCK_MONOTONIC, &next);
    for (unsigned long cycle = 1; !stop; cycle++) {
        /* Each cycle: take what has arrived, without waiting, and read all torques. A controller
         * may use torques[i] where statuses[i] is PROPRIO_OK; elsewhere it is NaN. */
        double torques[MAX_JOINTS], deviations[MAX_JOINTS];
        proprio_status statuses[MAX_JOINTS];
        proprio_update(reader, proprio_now());
        proprio_read_torques(reader, joints, joint_count, torques, deviations, statuses, NULL);

        if (cycle % 1000 == 0) { /* Once a second, for a person: not part of a cycle. */
            proprio_missing missing;
            if (!proprio_who_is_missing(reader, &missing)) {
                printf("%s\n", missing.text);
            }
            for (size_t i = 0; i < joint_count; i++) {
                if (statuses[i] == PROPRIO_OK) {
                    printf("  %-20s %10.4f Nm  +- %.4f\n", names[i], torques[i], deviations[i]);
                } else {
                    proprio_unavailable why;
                    proprio_read_torque(reader, joints[i], NULL, &why);
                    proprio_describe(&why, message, sizeof message);
                    printf("  %-20s %s\n", names[i], message);
                }
            }
            fflush(stdout);
            while (joint_count < MAX_JOINTS &&
                   proprio_torque_name(reader, joint_count, names[joint_count])) {
                joints[joint_count] = proprio_find_torque(reader, names[joint_count]);
                joint_count++;
            }
        }
        next.tv_nsec += 1000000;
        if (next.tv_nsec >= 1000000000) {
            next.tv_nsec -= 1000000000;
            next.tv_sec++;
        }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL);
    }
    proprio_reader_free(reader);
    return 0;
}
