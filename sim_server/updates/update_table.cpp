// SPDX-License-Identifier: MIT
// Sums up records in the table of updates (update_table.py), and ranks bodies for a factor (scheduler.py), for the service thread.
// NumPy lets go of Python's lock in each operation on more than 500 numbers, and where other threads are at work getting it back
// takes longer than the operation: a round of a thousand bodies took 60 of them.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "../backends/cpu/native/sizes.h"
#include "step_form.h"
#include "step_record.cuh"

// Each rounding as written: choices must not depend on what a compiler fuses.
#ifdef __clang__
#pragma clang fp contract(off)
#else
#pragma GCC optimize("fp-contract=off")
#endif

constexpr double MEMORY = 0.2;    // weight of the newest value in a running mean
constexpr int STAGES = 2;         // linear solves of a step of other forms than ONE_SOLVE
constexpr double OUTLOOK = 10.0;  // steps for which the excess of the last solve is taken to go on
constexpr int MAX_DOUBLINGS = 10; // of the least interval between matrices of an object whose jobs fail
constexpr int NO_STEP = -1;

// Columns of the table, of an entry for each body.
struct Table {
    double *excess, *latest, *lost, *iteration_cost, *cost, *first_excess, *latency;
    const double* error_bound;
    const int64_t* request;
    int64_t *factor_step, *max_factor_age, *refused, *newest, *sent, *checked, *failures, *used;
    bool* in_flight;
    const bool *dropped, *copying, *frozen;
    int64_t bodies;
};

// Columns of UpdateRequests, with room for all bodies.
struct Requests {
    int64_t *body, *waited, *age, *failures;
    double *excess, *iteration_cost, *factorization_cost, *lost, *latest;
    bool *in_flight, *on_trial;
};

// What records tell beside their sums.
enum Told { RAN_AWAY = 1, ABANDONED = 2 };

// What the rule `excess` ranks by; the other one, `round_robin`, by what a body has waited.
enum Rule { BY_EXCESS = 0, BY_WAITING = 1 };

static void add(double& mean, double value) { mean = std::isnan(mean) ? value : mean + MEMORY * (value - mean); }

// What a step adds to the sum by which its object is ranked. Of a step that iterates: its iterations above `floor` in each solve. Of
// a step by the factor alone: the estimate of its error over the bound [m], since it has no iterations, and a factor that ages costs
// accuracy instead.
static double excess(const Record& r, int floor, double error_bound) {
    if (r.form == FACTOR) return r.estimate / error_bound;
    const int stages = r.form == ONE_SOLVE ? 1 : STAGES;
    return std::max(r.iterations - floor * stages * std::max(r.linearizations, 1), 0);
}

static int32_t told_by(const Record& r) { return (r.status == RUNAWAY ? RAN_AWAY : 0) | (r.fallbacks > 0 ? ABANDONED : 0); }

// A rank: bodies without a matrix yet, then overdue ones, then by the rule; among equals the one that waited longest, then by order.
struct Ranked {
    int group;
    double first; // the largest goes first; NaN last
    int64_t waited;
    int64_t place;

    bool operator<(const Ranked& other) const {
        if (group != other.group) return group < other.group;
        if (first > other.first || (!std::isnan(first) && std::isnan(other.first))) return true;
        if (first < other.first || (std::isnan(first) && !std::isnan(other.first))) return false;
        if (waited != other.waited) return waited > other.waited;
        return place < other.place;
    }
};

extern "C" {

// What records tell: of Told.
int32_t wf_told(const Record* r, int64_t count) {
    int32_t told = 0;
    for (int64_t k = 0; k < count; ++k) told |= told_by(r[k]);
    return told;
}

// Takes note of whole steps, records (steps, bodies), as BodyUpdateState.observe does of each, in seconds. Returns what they tell.
int32_t wf_observe(const Table* t, const Record* records, int64_t steps, int32_t floor) {
    std::vector<double> above(steps);
    int32_t told = 0;
    for (int64_t b = 0; b < t->bodies; ++b) {
        const Record* first = records + b;
        const int64_t made = first->factor_step, newest = t->newest[b];
        bool one = true;
        double sum = 0;
        for (int64_t k = 0; k < steps; ++k) {
            const Record& r = first[k * t->bodies];
            told |= told_by(r);
            sum += above[k] = excess(r, floor, t->error_bound[b]);
            one = one && r.factor_step == made;
            add(t->iteration_cost[b], r.solve / (r.iterations + 1));
            t->refused[b] += r.fallbacks;
            if (r.factor_step >= 0) t->max_factor_age[b] = std::max<int64_t>(t->max_factor_age[b], r.step - 1 - r.factor_step);
        }
        if (one && (made < 0 || (made == t->factor_step[b] && made == newest))) {
            t->excess[b] += sum;
            t->lost[b] += made >= 0 ? sum : 0;
            t->latest[b] = above[steps - 1];
            continue;
        }
        for (int64_t k = 0; k < steps; ++k) {
            const int64_t step = first[k * t->bodies].factor_step;
            if (0 <= step && step < newest) continue; // a newer factor was taken up: this solve counts no more
            if (step >= 0 && step != t->factor_step[b]) {
                t->factor_step[b] = step;
                t->excess[b] = t->lost[b] = 0;
                add(t->first_excess[b], above[k]);
            }
            t->lost[b] += step >= 0 ? above[k] : 0;
            t->excess[b] += above[k];
            t->latest[b] = above[k];
        }
    }
    return told;
}

// Takes note of factors of different bodies, as BodyUpdateState.on_factor does of each, with costs in seconds.
// body, made, seconds: of each its body, the step of its matrix, and what its making cost. step: during which they came. newer: of each,
// whether it is newer than that of its body
void wf_factors(const Table* t, const int64_t* body, const int64_t* made, const double* seconds, int64_t count, int64_t step, bool* newer) {
    for (int64_t k = 0; k < count; ++k) {
        const int64_t b = body[k];
        const bool checked = made[k] == t->checked[b];
        if (checked || (t->in_flight[b] && made[k] == t->sent[b])) add(t->latency[b], std::max<int64_t>(1, step - made[k]));
        if (checked) t->checked[b] = NO_STEP;
        t->in_flight[b] = t->in_flight[b] && t->sent[b] > made[k];
        t->failures[b] = 0;
        newer[k] = made[k] > t->newest[b];
        if (!newer[k]) continue;
        add(t->cost[b], seconds[k]);
        t->newest[b] = made[k];
        ++t->used[b];
        t->lost[b] = 0;
        t->excess[b] = t->latest[b] = std::isnan(t->first_excess[b]) ? 0 : t->first_excess[b];
        if (t->sent[b] == NO_STEP) t->sent[b] = made[k]; // made elsewhere
    }
}

// Returns the mean of those numbers of a column that are known; NaN: none is.
double wf_mean(const double* column, int64_t bodies) {
    double sum = 0;
    int64_t known = 0;
    for (int64_t b = 0; b < bodies; ++b)
        if (!std::isnan(column[b])) sum += column[b], ++known;
    return known ? sum / known : NAN;
}

// Counts bodies whose copy is requested or waits to be sent, those with a job at a worker or a factor that is checked, and those with
// jobs that failed since their last factor.
void wf_count(const Table* t, int64_t* counts) {
    int64_t copying = 0, flying = 0, failing = 0;
    for (int64_t b = 0; b < t->bodies; ++b) {
        copying += t->copying[b];
        flying += t->in_flight[b] || t->checked[b] != NO_STEP;
        failing += t->failures[b] > 0;
    }
    counts[0] = copying, counts[1] = flying, counts[2] = failing;
}

// Writes the bodies whose copy is requested or waits to be sent, in the order of the requests; returns how many.
int64_t wf_copying(const Table* t, int64_t* body) {
    int64_t n = 0;
    for (int64_t b = 0; b < t->bodies; ++b)
        if (t->copying[b]) body[n++] = b;
    std::sort(body, body + n, [t](int64_t one, int64_t other) { return t->request[one] < t->request[other]; });
    return n;
}

// Writes the requests of all bodies but frozen ones, or only of those whose matrix may go `ahead` of the check of their last factor
// (Driver.requests); returns how many. on_trial, compared: of each body, what `auto` wants; null: nothing.
int64_t wf_requests(const Table* t, int64_t step, int32_t ahead, const bool* on_trial, const bool* compared, const Requests* out) {
    int64_t n = 0;
    for (int64_t b = 0; b < t->bodies; ++b) {
        const bool checked = t->checked[b] != NO_STEP;
        const int64_t age = t->newest[b] >= 0 && !t->dropped[b] ? step - t->newest[b] : NO_STEP;
        const bool last = checked && t->sent[b] == t->checked[b] && age >= 0 && t->failures[b] == 0 && !(compared && compared[b]);
        if (t->frozen[b] || (ahead && !last)) continue;
        out->body[n] = b;
        out->excess[n] = t->excess[b];
        out->waited[n] = t->sent[b] >= 0 ? step - t->sent[b] : NO_STEP;
        out->in_flight[n] = t->in_flight[b] || t->copying[b] || (checked && !ahead);
        out->age[n] = age;
        out->iteration_cost[n] = std::isnan(t->iteration_cost[b]) ? 1 : t->iteration_cost[b];
        out->factorization_cost[n] = std::isnan(t->cost[b]) ? 1 : t->cost[b];
        out->failures[n] = t->failures[b];
        out->lost[n] = t->lost[b];
        out->on_trial[n] = on_trial && on_trial[b];
        out->latest[n] = t->latest[b];
        ++n;
    }
    return n;
}

// Writes the numbers of up to `places` of `count` bodies, the most urgent first (scheduler.pick); returns how many.
int64_t wf_pick(const Requests* q, int64_t count, int64_t places, int64_t min_interval, int32_t rule, double overdue, int64_t* chosen) {
    std::vector<Ranked> ready;
    ready.reserve(count);
    for (int64_t k = 0; k < count; ++k) {
        const int64_t waited = q->waited[k];
        const bool unsent = waited < 0, late = waited >= overdue;
        if (q->in_flight[k] || !(unsent || waited >= min_interval << std::min<int64_t>(q->failures[k], MAX_DOUBLINGS))) continue;
        // The sum as it will be OUTLOOK steps from now if the excess of the last solve goes on, and what was waited for it
        const double sum = q->excess[k] + OUTLOOK * q->latest[k];
        const double need = rule == BY_EXCESS ? sum * std::sqrt(double(std::max<int64_t>(waited, 1))) : waited;
        ready.push_back({unsent ? 0 : late ? 1 : 2, unsent ? q->excess[k] : late ? waited : need, unsent ? 0 : waited, k});
    }
    const int64_t n = std::min<int64_t>(std::max<int64_t>(places, 0), ready.size());
    std::partial_sort(ready.begin(), ready.begin() + n, ready.end());
    for (int64_t k = 0; k < n; ++k) chosen[k] = q->body[ready[k].place];
    return n;
}

const StructSize* wf_sizes() {
    static const StructSize sizes[] = {SIZE(Table), SIZE(Requests), SIZE(Record), {}};
    return sizes;
}
}
