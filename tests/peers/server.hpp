// The common part of the C++ programs here: the states, and the protocol of drive.py, which
// server.rs describes.
#pragma once

#include <array>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <functional>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

namespace peers {

[[noreturn]] inline void fail(const std::string& message)
{
    std::cerr << "peers: " << message << std::endl;
    std::exit(1);
}

using Triple = std::array<double, 3>;

struct State
{
    std::vector<double> position, velocity, acceleration;
    // Motion of the base in its own axes, which are those of the world. The acceleration is
    // classical, without subtraction of gravity.
    Triple baseAngularVelocity, baseVelocity, baseAngularAcceleration, baseAcceleration;
    // Force, torque.
    std::vector<std::array<Triple, 2>> readings;
};

struct States
{
    std::vector<std::string> joints, sensors, bodies, contacts;
    Triple gravity;
    std::vector<std::array<double, 10>> parameters;
    std::vector<State> states;

    explicit States(const std::string& path)
    {
        std::ifstream in(path);
        if (!in)
            fail("cannot read " + path);
        in.exceptions(std::ios::failbit | std::ios::badbit);
        try
        {
            joints = names(in, "joints");
            sensors = names(in, "sensors");
            bodies = names(in, "bodies");
            contacts = names(in, "contacts");
            key(in, "gravity");
            fill(in, gravity);
            key(in, "parameters");
            parameters.resize(bodies.size());
            for (auto& values : parameters)
                fill(in, values);
            key(in, "states");
            std::size_t count = 0;
            in >> count;
            states.resize(count);
            for (State& state : states)
            {
                for (auto* values : {&state.position, &state.velocity, &state.acceleration})
                {
                    values->resize(joints.size());
                    fill(in, *values);
                }
                for (auto* values :
                     {&state.baseAngularVelocity, &state.baseVelocity,
                      &state.baseAngularAcceleration, &state.baseAcceleration})
                    fill(in, *values);
                state.readings.resize(sensors.size());
                for (auto& reading : state.readings)
                    for (Triple& part : reading)
                        fill(in, part);
            }
        } catch (const std::ios::failure&)
        {
            fail(path + " ends early or has a wrong number");
        }
    }

    // Spatial acceleration of the base's origin without gravity: the classical one minus omega x v.
    Triple baseSpatialAcceleration(const State& state) const
    {
        const Triple &w = state.baseAngularVelocity, &v = state.baseVelocity,
                     &a = state.baseAcceleration;
        return {
            a[0] - (w[1] * v[2] - w[2] * v[1]), a[1] - (w[2] * v[0] - w[0] * v[2]),
            a[2] - (w[0] * v[1] - w[1] * v[0])};
    }

private:
    static void key(std::istream& in, const std::string& wanted)
    {
        std::string word;
        in >> word;
        if (word != wanted)
            fail("states: '" + word + "' instead of '" + wanted + "'");
    }

    static std::vector<std::string> names(std::istream& in, const std::string& wanted)
    {
        key(in, wanted);
        std::size_t count = 0;
        in >> count;
        std::vector<std::string> found(count);
        for (std::string& name : found)
            in >> name;
        return found;
    }

    template <class Values> static void fill(std::istream& in, Values& values)
    {
        for (double& value : values)
            in >> value;
    }
};

// The index of a name in a list.
inline std::size_t place(const std::vector<std::string>& names, const std::string& name)
{
    for (std::size_t at = 0; at < names.size(); ++at)
        if (names[at] == name)
            return at;
    fail(name + " is not in the states");
}

// The outputs at one state, by name.
class Output
{
public:
    void add(const std::string& kind, const std::string& name, double value)
    {
        char number[32];
        std::snprintf(number, sizeof number, "%.17g", value);
        text += kind + "/" + name + "=" + number + " ";
    }

    template <class Vector>
    void add3(const std::string& kind, const std::string& name, const Vector& values)
    {
        for (int axis = 0; axis < 3; ++axis)
            add(kind, name + "." + "xyz"[axis], values[axis]);
    }

    std::string text;
};

struct Row
{
    std::string name;
    // The timed calls, at the state with this number.
    std::function<void(std::size_t)> run;
    // The outputs of the last run.
    std::function<void(Output&)> show;
};

// Nanoseconds per call. An untimed round of all states first fills the caches.
inline double nanoseconds(const Row& row, std::size_t states, std::size_t calls)
{
    for (std::size_t state = 0; state < states; ++state)
        row.run(state);
    const auto start = std::chrono::steady_clock::now();
    for (std::size_t call = 0; call < calls; ++call)
        row.run(call % states);
    const std::chrono::duration<double, std::nano> passed
        = std::chrono::steady_clock::now() - start;
    return passed.count() / static_cast<double>(calls);
}

// Answers requests until standard input ends.
inline void serve(std::size_t states, const std::vector<Row>& rows)
{
    for (std::string line; std::getline(std::cin, line);)
    {
        std::istringstream words(line);
        std::string what, name;
        std::size_t count = 0;
        words >> what;
        if (what == "rows")
        {
            for (const Row& row : rows)
                std::cout << row.name << ' ';
            std::cout << std::endl;
            continue;
        }
        const Row* found = nullptr;
        if (words >> name >> count)
            for (const Row& row : rows)
                if (row.name == name)
                    found = &row;
        if (found && what == "time")
        {
            std::cout << nanoseconds(*found, states, count) << std::endl;
        } else if (found && what == "show")
        {
            Output output;
            found->run(count);
            found->show(output);
            std::cout << output.text << std::endl;
        } else
            fail("cannot do '" + line + "'");
    }
}

} // namespace peers
