// proprio.h for C++17: readers that end by themselves, values or the reason why there is none,
// instants and durations of std::chrono. Functions for the cycle neither throw nor allocate.
#ifndef PROPRIO_HPP
#define PROPRIO_HPP

#include "proprio.h"

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace proprio {

using nanoseconds = std::chrono::nanoseconds;

/// CLOCK_MONOTONIC, the clock of all instants here.
inline nanoseconds now() { return nanoseconds(proprio_now()); }

/// Why there is no value.
class Unavailable {
public:
    explicit Unavailable(const proprio_unavailable &why) : why_(why) {}
    proprio_status status() const { return why_.status; }
    /// Only with PROPRIO_WITHHELD.
    proprio_reason reason() const { return why_.reason; }
    /// How old the last value is; 0 if there is none.
    nanoseconds age() const { return nanoseconds(why_.age); }
    /// The channel that is the cause; empty if there is no single one.
    const char *channel() const { return why_.channel; }
    /// In words, as "withheld: saturated (l_arm_ft_sensor)". Allocates.
    std::string text() const {
        char text[256] = "";
        proprio_describe(&why_, text, sizeof text);
        return text;
    }

private:
    proprio_unavailable why_;
};

/// A value, or why there is none.
template <typename T> class Result {
public:
    explicit operator bool() const { return status_ == PROPRIO_OK; }
    bool has_value() const { return status_ == PROPRIO_OK; }
    /// The value; all NaN if there is none.
    const T &operator*() const { return value_; }
    const T *operator->() const { return &value_; }
    T value_or(const T &other) const { return has_value() ? value_ : other; }
    /// Only if there is no value.
    Unavailable why() const { return Unavailable(why_); }

private:
    friend class Reader;
    Result() = default;
    T value_{};
    proprio_unavailable why_{};
    proprio_status status_ = PROPRIO_UNKNOWN;
};

/// Who is missing.
struct Missing {
    proprio_presence gateway;
    proprio_presence estimator;
    /// Both are running, and nothing else is wrong.
    bool is_nobody;
    /// The same and what else is wrong, in words.
    std::string text;
};

/// The domain of a gateway, an estimator and their readers.
struct Domain {
    /// The folder; the environment's PROPRIO_RUNTIME_DIR if there is none.
    std::optional<std::string> runtime_dir{};
    /// The name; the environment's PROPRIO_DOMAIN if there is none.
    std::optional<std::string> name{};
};

/// The newest state of one robot. Only one thread may use it at a time. Call update() once in each
/// cycle, and read values after it: no system call, no lock, no allocation.
class Reader {
public:
    /// A reader of `robot`, whose gateway and estimator need not run yet. Torques and contacts are
    /// stale after `max_age`. Throws std::runtime_error if its thread cannot be started.
    explicit Reader(const std::string &robot, nanoseconds max_age, const Domain &domain = {}) {
        const auto text = [](const auto &of) { return of ? of->c_str() : nullptr; };
        char why[256] = "";
        reader_ = proprio_reader_new(robot.c_str(), max_age.count(), text(domain.runtime_dir),
                                     text(domain.name), why, sizeof why);
        if (reader_ == nullptr) {
            throw std::runtime_error(why);
        }
    }
    ~Reader() { proprio_reader_free(reader_); }
    Reader(Reader &&other) noexcept : reader_(std::exchange(other.reader_, nullptr)) {}
    Reader &operator=(Reader &&other) noexcept {
        std::swap(reader_, other.reader_);
        return *this;
    }
    Reader(const Reader &) = delete;
    Reader &operator=(const Reader &) = delete;

    /// Handles stay good as long as the reader, whatever is restarted. Not for the cycle.
    proprio_torque_handle find_torque(const std::string &joint) {
        return proprio_find_torque(reader_, joint.c_str());
    }
    proprio_contact_handle find_contact(const std::string &contact) {
        return proprio_find_contact(reader_, contact.c_str());
    }
    /// `kind` is PROPRIO_KIND_...
    proprio_channel_handle find_channel(std::uint32_t kind, const std::string &name) {
        return proprio_find_channel(reader_, kind, name.c_str());
    }

    /// Takes what has arrived.
    void update(nanoseconds now = proprio::now()) noexcept { proprio_update(reader_, now.count()); }
    /// Waits for an estimate, at most until `deadline`; whether one may have arrived.
    bool wait_for_estimate(nanoseconds deadline) const noexcept {
        return proprio_wait_for_estimate(reader_, deadline.count());
    }
    /// The same for a sample of any channel.
    bool wait_for_sample(nanoseconds deadline) const noexcept {
        return proprio_wait_for_sample(reader_, deadline.count());
    }

    Result<proprio_torque> torque(proprio_torque_handle joint) const noexcept {
        return read<proprio_torque>(proprio_read_torque, joint);
    }
    /// The torques of `count` joints into arrays, each of which may be null: how many have a value.
    std::size_t torques(const proprio_torque_handle *joints, std::size_t count, double *torques,
                        double *standard_deviations = nullptr, proprio_status *statuses = nullptr,
                        std::int64_t *acquired = nullptr) const noexcept {
        return proprio_read_torques(reader_, joints, count, torques, standard_deviations, statuses,
                                    acquired);
    }
    Result<proprio_contact> contact(proprio_contact_handle contact) const noexcept {
        return read<proprio_contact>(proprio_read_contact, contact);
    }
    Result<proprio_joint_state> joint(proprio_channel_handle channel) const noexcept {
        return read<proprio_joint_state>(proprio_read_joint, channel);
    }
    Result<proprio_wrench> wrench(proprio_channel_handle channel) const noexcept {
        return read<proprio_wrench>(proprio_read_wrench, channel);
    }
    Result<proprio_imu> imu(proprio_channel_handle channel) const noexcept {
        return read<proprio_imu>(proprio_read_imu, channel);
    }

    /// The estimator's joints in its order; empty until it has been seen. Not for the cycle.
    std::vector<std::string> torque_names() const { return names(proprio_torque_name); }
    /// The estimator's contacts. Not for the cycle.
    std::vector<std::string> contact_names() const { return names(proprio_contact_name); }
    /// The gateway's channels: kind and name. Not for the cycle.
    std::vector<std::pair<std::uint32_t, std::string>> channel_names() const {
        std::vector<std::pair<std::uint32_t, std::string>> all;
        char name[PROPRIO_NAME_SIZE];
        std::uint32_t kind = 0;
        while (proprio_channel_name(reader_, all.size(), name, &kind)) {
            all.emplace_back(kind, name);
        }
        return all;
    }
    /// Who is missing. Not for the cycle.
    Missing who_is_missing() const {
        proprio_missing missing{};
        proprio_who_is_missing(reader_, &missing);
        return {missing.gateway, missing.estimator, missing.is_nobody, missing.text};
    }

    /// The reader for functions of proprio.h.
    proprio_reader *get() const { return reader_; }

private:
    template <typename T, typename Read, typename Handle>
    Result<T> read(Read function, Handle handle) const noexcept {
        Result<T> result;
        result.status_ = function(reader_, handle, &result.value_, &result.why_);
        return result;
    }
    template <typename Name> std::vector<std::string> names(Name function) const {
        std::vector<std::string> all;
        char name[PROPRIO_NAME_SIZE];
        while (function(reader_, all.size(), name)) {
            all.emplace_back(name);
        }
        return all;
    }

    proprio_reader *reader_ = nullptr;
};

} // namespace proprio

#endif // PROPRIO_HPP
