/* A control loop in which every system call but write is fatal, and every allocation and release is told.
 * Writes '+' after 20,000 cycles of which one had all values, '-' if none had, 'a' if one allocated.
 */
#define _GNU_SOURCE
#include <linux/seccomp.h>
#include <proprio.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <unistd.h>

static __thread int is_cycle;
static __thread int allocations;

extern void *__libc_malloc(size_t size);
extern void *__libc_realloc(void *old, size_t size);
extern void *__libc_calloc(size_t count, size_t size);
extern void *__libc_memalign(size_t alignment, size_t size);
extern void __libc_free(void *memory);
void *malloc(size_t size) {
    allocations += is_cycle;
    return __libc_malloc(size);
}
void *realloc(void *old, size_t size) {
    allocations += is_cycle;
    return __libc_realloc(old, size);
}
void *calloc(size_t count, size_t size) {
    allocations += is_cycle;
    return __libc_calloc(count, size);
}

int posix_memalign(void **memory, size_t alignment, size_t size) {
    allocations += is_cycle;
    *memory = __libc_memalign(alignment, size);
    return *memory == NULL;
}
void *aligned_alloc(size_t alignment, size_t size) {
    allocations += is_cycle;
    return __libc_memalign(alignment, size);
}
void free(void *memory) {
    allocations += is_cycle && memory != NULL;
    __libc_free(memory);
}

int main(void) {
    proprio_reader *reader =
        proprio_reader_new("icub_left_arm", 20000000000, NULL, NULL, NULL, 0);
    const proprio_torque_handle joints[2] = {proprio_find_torque(reader, "l_elbow"),
                                             proprio_find_torque(reader, "l_wrist_yaw")};
    const proprio_contact_handle hand = proprio_find_contact(reader, "hand");
    const proprio_channel_handle elbow = proprio_find_channel(reader, PROPRIO_KIND_JOINT, "l_elbow");
    const proprio_channel_handle sensor =
        proprio_find_channel(reader, PROPRIO_KIND_WRENCH, "l_arm_ft_sensor");
    const proprio_channel_handle imu = proprio_find_channel(reader, PROPRIO_KIND_IMU, "chest_imu");
    int64_t now = proprio_now(); /* a clock may be a system call on some machines */
    prctl(PR_SET_SECCOMP, SECCOMP_MODE_STRICT);
    for (;;) {
        int best = 0;
        is_cycle = 1;
        for (int i = 0; i < 20000; i++) {
            double torques[2];
            proprio_contact contact;
            proprio_joint_state state;
            proprio_wrench wrench;
            proprio_imu motion;
            proprio_unavailable why;
            proprio_update(reader, now++);
            int count = (int)proprio_read_torques(reader, joints, 2, torques, NULL, NULL, NULL);
            (void)proprio_read_contact(reader, hand, &contact, &why);
            count += proprio_read_joint(reader, elbow, &state, &why) == PROPRIO_OK;
            count += proprio_read_wrench(reader, sensor, &wrench, &why) == PROPRIO_OK;
            count += proprio_read_imu(reader, imu, &motion, &why) == PROPRIO_OK;
            best = count > best ? count : best;
        }
        is_cycle = 0;
        if (write(1, allocations > 0 ? "a" : best == 5 ? "+" : "-", 1) != 1) {
            return 1;
        }
    }
}
