// An example in C++: waits for each estimate of a robot, and says when a contact is pushed, how
// hard, and what an encoder and an F/T sensor measure meanwhile. Ctrl-C ends it.
//
//     c++ -std=c++17 push.cpp $(pkg-config --cflags --libs proprio) -o push
//     ./push icub_left_arm hand l_elbow l_arm_ft_sensor
#include <cmath>
#include <csignal>
#include <cstdio>
#include <exception>
#include <proprio.hpp>

using namespace std::chrono_literals;

static volatile std::sig_atomic_t stop = 0;

static int run(int count, char **words) {
    if (count < 5) {
        std::fprintf(stderr, "usage: push ROBOT CONTACT JOINT FT_SENSOR\n");
        return 2;
    }
    proprio::Reader robot(words[1], 50ms);
    const auto contact = robot.find_contact(words[2]);
    const auto encoder = robot.find_channel(PROPRIO_KIND_JOINT, words[3]);
    const auto sensor = robot.find_channel(PROPRIO_KIND_WRENCH, words[4]);
    bool was_pushed = false;
    while (!stop) {
        if (!robot.wait_for_estimate(proprio::now() + 500ms)) {
            std::printf("no estimate: %s\n", robot.who_is_missing().text.c_str());
            std::fflush(stdout);
        }
        robot.update();
        const auto push = robot.contact(contact);
        const auto *f = push->force; // NaN if there is no contact
        const double force = std::sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2]);
        const bool is_pushed = force > 2.0;
        if (is_pushed && !was_pushed) {
            std::printf("pushed with %.1f N", force);
            if (const auto joint = robot.joint(encoder)) {
                std::printf(", %s at %.3f rad", words[3], joint->position);
            }
            if (const auto wrench = robot.wrench(sensor)) {
                std::printf(", %s reads %.1f N along z", words[4], wrench->force[2]);
            }
            std::printf("\n");
            std::fflush(stdout);
        }
        was_pushed = is_pushed;
    }
    const auto last = robot.contact(contact);
    std::printf("at the end: %s\n", last ? "in contact" : last.why().text().c_str());
    return 0;
}

int main(int count, char **words) {
    std::signal(SIGINT, [](int) { stop = 1; });
    std::signal(SIGTERM, [](int) { stop = 1; });
    try {
        return run(count, words);
    } catch (const std::exception &error) {
        std::fprintf(stderr, "push: %s\n", error.what());
        return 1;
    }
}
