/* A program forks while it reads torques; the child ends the reader that it has a copy of. Writes
 * "goes on" when a torque that is newer than the fork has come. */
#include <proprio.h>
#include <stdio.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <unistd.h>

static int64_t newest(proprio_reader *reader, proprio_torque_handle joint) {
    proprio_torque torque;
    proprio_wait_for_estimate(reader, proprio_now() + 10000000);
    proprio_update(reader, proprio_now());
    return proprio_read_torque(reader, joint, &torque, NULL) == PROPRIO_OK ? torque.acquired : 0;
}

int main(void) {
    proprio_reader *reader = proprio_reader_new("icub_left_arm", 50000000, NULL, NULL, NULL, 0);
    const proprio_torque_handle joint = proprio_find_torque(reader, "l_elbow");
    while (newest(reader, joint) == 0) {
    }
    const pid_t child = fork();
    if (child == 0) {
        proprio_reader_free(reader);
        return 0;
    }
    int status = 1;
    waitpid(child, &status, 0);
    const int64_t forked = proprio_now();
    while (newest(reader, joint) < forked + 100000000) {
    }
    printf("goes on, the child ended with %d\n", status);
    proprio_reader_free(reader);
    return status;
}
