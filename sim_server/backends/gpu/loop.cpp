// SPDX-License-Identifier: MIT
// The simulation loop on a GPU. It launches the graph of a step repeatedly and reads the results once per batch. The next batch
// is launched before the results of the last one are read, so that the device never waits for this thread. The device writes records
// into their ring by itself (step_records.cu); this thread adds what only it knows, and what only some scenes have. The rest of the
// server sends data through mail slots, which are read before each batch. The thread runs without Python's lock. The functions of the
// driver are a table, so that tests need no GPU.
#include <sys/prctl.h>

#include <algorithm>
#include <cstddef>
#include <vector>

#include "../cpu/native/pair_wrenches.h"
#include "../cpu/native/sizes.h"
#include "../cpu/native/start_of_balance.h"
#include "launch_build.h"
#include "readback.h"
#include "step_form.h"

// Copies new arguments, settings and factors to the device, in the order of the steps, from memory that stays unchanged meanwhile.
static bool deliver(GpuLoop& l, StepBatch& batch, int slots) {
    if (!l.posted.exchange(0, std::memory_order_acquire)) return true;
    bool left = slots < l.mail_slot_count;
    static thread_local std::vector<DeviceCopy> copies;
    copies.clear();
    int64_t used = sizeof(CopyList);
    void* over = nullptr;  // the last event that was found to have completed
    for (int k = 0; k < slots; ++k) {
        MailSlot& slot = l.mail_slots[k];
        if (!slot.pending && slot.posted.load(std::memory_order_relaxed)) slot.pending = slot.posted.exchange(nullptr);
        if (!slot.pending) continue;
        if (void* event = slot.pending->event; event && event != over) {  // mail of a batch has one event
            if (!done(l, event)) {
                left = true;
                continue;
            }
            over = event;
        }
        std::memcpy(batch.mail.list + used, slot.pending->bytes, slot.size);
        copies.push_back({(char*)slot.target, (const char*)(batch.mail.target + used), slot.size});
        used += (slot.size + 15) / 16 * 16;
        if (&slot == l.touch) std::memcpy(&l.touched, slot.pending->bytes, sizeof l.touched);  // n, its first member
        int64_t number = slot.pending->number;
        slot.after = l.launched;
        slot.pending->taken.store(slot.after, std::memory_order_release);
        slot.pending = nullptr;
        slot.taken.store(number, std::memory_order_release);
    }
    if (left) l.posted.store(1, std::memory_order_relaxed);
    return !l.error && make_copies(l, batch.mail, copies, used);
}

// Makes the changes of parameters that wait, in the order of the steps; the balance of the last step has been made.
static bool take_changes(GpuLoop& l) {
    if (!l.changes.load(std::memory_order_relaxed)) return true;
    DeviceChanges* next = l.changes.exchange(nullptr);
    if (!next) return true;
    CALL(graph_launch, next->before, l.stream);
    for (int64_t i = 0; i < next->count; ++i)
        CALL(on_device, (Address)next->copies[i].target, (Address)next->copies[i].source, (size_t)next->copies[i].bytes, l.stream);
    for (int i = 0; next->places && i < l.bodies; ++i) {
        l.readbacks[i].values_begin = next->places[2 * i];
        l.readbacks[i].values_bytes = next->places[2 * i + 1];
    }
    CALL(graph_launch, next->after, l.stream);
    next->taken.store(l.launched, std::memory_order_release);
    return true;
}

static bool open_batch(GpuLoop& l) {
    StepBatch& batch = l.batches[l.begun % STEP_BATCHES];
    batch.first = l.launched;
    batch.steps = 0;
    batch.late = l.rings.late;
    if (!deliver(l, batch, l.mail_slot_count) || !take_changes(l)) return false;
    batch.touched = l.grabs && l.touched;
    return true;
}

// Counts steps that were launched, and launches what follows them: forces on grabs, energies, copies of matrices and frames.
static bool count(GpuLoop& l, int64_t steps) {
    l.launched += steps;
    l.batches[l.begun % STEP_BATCHES].steps += steps;
    if (l.batches[l.begun % STEP_BATCHES].touched) CALL(graph_launch, l.grabs, l.stream);
    const bool energy = energy_due(l.rings, l.launched), frame = frame_due(l.rings, l.launched);
    if (energy || frame) CALL(graph_launch, l.energy_balance, l.stream);  // a frame shows frozen bodies at their last valid state
    if (energy) CALL(graph_launch, l.elastic_energy, l.stream);
    return begin_matrices(l, false) && copy_frame(l);
}

// Has the device write the records of `steps` steps from `first` on, and notes the end of that in the event of the batch.
static bool write_records(GpuLoop& l, StepBatch& batch, int64_t first, int64_t steps, int64_t place) {
    *batch.target = {first, steps, place};
    CALL(graph_launch, batch.records, l.stream);
    CALL(event_record, batch.done, l.stream);
    return true;
}

// Number of the first record of the batch that ends now; -1 where the ring has no room for all of them, or batches under way have no
// place yet.
static int64_t place_of_records(const GpuLoop& l, int64_t steps) {
    const Rings& rings = l.rings;
    int64_t place = rings.record_head.load();
    for (int64_t k = l.finished; k < l.begun; ++k) {
        const StepBatch& before = l.batches[k % STEP_BATCHES];
        if (before.place < 0) return -1;
        place = before.place + before.steps * l.bodies;
    }
    return place + steps * l.bodies - rings.record_tail.load(std::memory_order_acquire) <= rings.record_capacity ? place : -1;
}

static bool close_batch(GpuLoop& l) {
    StepBatch& batch = l.batches[l.begun % STEP_BATCHES];
    batch.place = place_of_records(l, batch.steps);
    if (!write_records(l, batch, batch.first, batch.place < 0 ? 0 : batch.steps, batch.place)) return false;
    ++l.begun;
    return true;
}

// Whether matrices are asked for or on their way, or mail waits: what follows goes on sooner after shorter batches.
static bool exchanges(const GpuLoop& l) {
    return l.matrix_step >= 0 || l.requested.load(std::memory_order_relaxed) || l.posted.load(std::memory_order_relaxed);
}

// The ring has room for the records of three batches, those under way and one that is read meanwhile: one that finds no room is slow.
static int64_t batch_size(GpuLoop& l, int64_t left) {
    const double aim = exchanges(l) ? l.exchange_seconds : l.batch_seconds;
    int64_t size = l.rings.realtime || l.step_seconds == 0 ? 1 : (int64_t)(aim / l.step_seconds) + 1;
    const int64_t room = l.rings.record_capacity / (3 * l.bodies);
    return std::max<int64_t>(1, std::min({size, left, room, l.batch - l.launched % l.batch}));  // so none goes over the end of the device's rings
}

// True if none of the next n - 1 steps is a multiple of `every`.
static bool none_within(const GpuLoop& l, int64_t every, int64_t n) { return every <= 0 || every - l.launched % every >= n; }

// The graph of most steps, `left` at most, after none of which but the last one something else is due.
static int largest_graph(const GpuLoop& l, int64_t left) {
    const int64_t frame_every = l.rings.frame_every.load(), energy_every = l.rings.energy_every.load();
    int size = 0;
    for (int k = 1; k < GRAPH_SIZES && l.sizes[k] <= left; ++k)
        if (l.graphs[0][k] && none_within(l, frame_every, l.sizes[k]) && none_within(l, energy_every, l.sizes[k])) size = k;
    return size;
}

static bool launch_batch(GpuLoop& l, int64_t steps) {
    if (!open_batch(l)) return false;
    if (l.begun == l.finished || done(l, l.batches[(l.begun - 1) % STEP_BATCHES].done)) {
        l.ran_dry = 1;
        l.idle_since = now();
    }
    for (int64_t left = steps; left > 0;) {
        const bool wanted = l.requested.load(std::memory_order_relaxed) && l.matrix_step < 0;
        const int size = wanted || l.batches[l.begun % STEP_BATCHES].touched ? 0 : largest_graph(l, left);
        if (wanted && !begin_matrices(l, true)) return false;
        CALL(graph_launch, l.graphs[l.ran_dry][size], l.stream);
        l.ran_dry = 0;
        if (!count(l, l.sizes[size])) return false;
        left -= l.sizes[size];
    }
    return close_batch(l);
}

// from: of the body in the results. place: of the record.
static void note_contact(GpuLoop& l, int64_t from, Record& record, int64_t place) {
    const ContactResult& r = l.contact_results[from];
    record.contacts = r.contacts;
    record.passes = r.passes;
    record.clipped = r.clipped;
    record.contact_residual = r.residual;
    const int64_t numbers = 6 * l.obstacles;
    double* target = l.rings.reactions + 6 * l.rings.reaction_count * place;
    std::memcpy(target, l.contact_reactions + numbers * from, sizeof(double) * numbers);
}

static void note_holders(GpuLoop& l, int64_t from, int64_t place) {
    const int64_t numbers = 6 * l.holders;
    double* end = l.rings.reactions + 6 * l.rings.reaction_count * (place + 1);
    std::memcpy(end - numbers, l.held_reactions + numbers * from, sizeof(double) * numbers);
}

// from: place of the step in the results. place: of the record of body i.
static void note_readings(GpuLoop& l, int64_t from, int i, int64_t place) {
    const double* first = l.measured + l.measured_count * from;
    std::copy(first + l.measured_first[i], first + l.measured_first[i + 1], l.rings.readings + l.rings.most_readings * place);
}

// Puts what bodies exerted on grabs in a step into the ring. from: place of the step in the results.
static void report_grabs(GpuLoop& l, int64_t from) {
    static thread_local std::vector<Reaction> found;
    found.clear();
    const int64_t count = std::min(l.grab_counts[from], l.most_grabs);
    for (int64_t k = 0; k < count; ++k) {
        const Reaction& r = l.grab_reactions[from * l.most_grabs + k];
        if (r.number >= 0) found.push_back(r);
    }
    l.rings.others_dropped += l.grab_counts[from] - count;
    put_reactions(l.rings, found.data(), (int64_t)found.size(), [&] { publish(l); return true; });
}

// Puts what bodies exerted on each other in a step into the ring. from: place of the step in the results.
static void report_pairs(GpuLoop& l, int64_t from, int64_t step) {
    static thread_local std::vector<Reaction> found;
    found.clear();
    const int32_t* counts = l.pair_counts + from * l.bodies;
    for (int i = 0; i < l.bodies; ++i) l.rings.others_dropped += std::max<int64_t>(0, counts[i] - l.most_pairs);
    add_pairs(l.bodies, step, found, [&](int i) {
        return Span{l.pair_sums + (from * l.bodies + i) * l.most_pairs, (int)std::min<int64_t>(counts[i], l.most_pairs)};
    });
    put_reactions(l.rings, found.data(), (int64_t)found.size(), [&] { publish(l); return true; });
}

// Adds what only some scenes have to the record of body i. from: of the body in the results. place: of the record.
static void note_others(GpuLoop& l, int64_t from, int i, int64_t place) {
    Record& record = l.rings.records[place];
    if (l.newton_results) {
        record.nonlinear = l.newton_results[from].nonlinear;
        record.linearizations = l.newton_results[from].linearizations;
        if (l.newton_results[from].step_error > 0) record.step_error = l.newton_results[from].step_error;
    }
    if (l.stage_results) {
        record.form = l.stage_results[from].form;
        record.estimate = l.stage_results[from].estimate;
        if (record.form == FACTOR) record.residual = l.stage_results[from].inconsistency;
    }
    if (l.substep_results) {
        record.substeps = l.substep_results[from].substeps;
        record.stable_step = l.substep_results[from].stable_step;
    }
    if (l.contact_results) note_contact(l, from, record, place);
    if (l.held_reactions) note_holders(l, from, place);
    if (l.measured) note_readings(l, from / l.bodies, i, place);
}

// Whether the k-th step of the batch has its records in the ring, from record_head on. Where the ring had no room when the batch
// ended, they are written now, if it has.
static bool has_records(GpuLoop& l, StepBatch& batch, int64_t k) {
    if (batch.place >= 0) return true;
    if (!room_for_records(l.rings, l.bodies, [&] { publish(l); return true; })) return false;
    return write_records(l, batch, batch.first + k, 1, l.rings.record_head.load()) && await(l, batch.done);
}

static void report(GpuLoop& l, StepBatch& batch, int64_t k, double end, double cpu) {
    Rings& rings = l.rings;
    const StepTimestamp &stamp = l.timestamps[(batch.first + k) % l.capacity];
    const StepTimestamp &last = l.timestamps[(batch.first + batch.steps - 1) % l.capacity];
    const int64_t from = (batch.first + k) % l.capacity, step = batch.first + k + 1, head = rings.record_head.load();
    const bool keep = has_records(l, batch, k);
    if (l.error) return;
    Record known;
    known.step = step;
    known.time = rings.start_time + step * rings.dt;
    known.whole = 1e-9 * (stamp.end - stamp.begin);
    known.late = k ? 0 : batch.late;
    known.begin = end - 1e-9 * (last.end - stamp.begin);
    known.cpu = cpu;
    const bool others = l.newton_results || l.stage_results || l.substep_results || l.contact_results || l.held_reactions || l.measured;
    int64_t place = head % rings.record_capacity;
    for (int i = 0; keep && i < l.bodies; ++i) {
        known.body = i;
        std::memcpy(&rings.records[place], &known, offsetof(Record, iterations));
        if (others) note_others(l, from * l.bodies + i, i, place);
        if (++place == rings.record_capacity) place = 0;
    }
    rings.step.store(step);
    *l.clock = rings.start_time + step * rings.dt;
    if (keep && batch.touched) report_grabs(l, from);
    if (keep && l.pair_sums) report_pairs(l, from, step);
    if (keep) rings.record_head.store(head + l.bodies, std::memory_order_release);
    else rings.records_dropped += l.bodies;
}

static bool finish_batch(GpuLoop& l) {
    StepBatch& batch = l.batches[l.finished % STEP_BATCHES];
    const double lasts = l.step_seconds * batch.steps;
    if (!await(l, batch.done, l.idle_since + lasts, lasts, [&l] { return publish_meanwhile(l); })) return false;
    double end = l.idle_since = now(), cpu = thread_time();
    const StepTimestamp &first = l.timestamps[batch.first % l.capacity], &last = l.timestamps[(batch.first + batch.steps - 1) % l.capacity];
    l.step_seconds = 1e-9 * (last.end - first.begin) / batch.steps;
    for (int64_t k = 0; k < batch.steps && !l.error; ++k) report(l, batch, k, end, (cpu - l.cpu) / batch.steps);
    l.cpu = cpu;
    ++l.finished;
    publish(l);
    return !l.error;
}

static bool finish_down_to(GpuLoop& l, int64_t under_way) {
    while (l.begun - l.finished > under_way)
        if (!finish_batch(l)) return false;
    return true;
}

// Waits until the next step is due, and finishes batches and copies under way meanwhile.
static Due wait(GpuLoop& l) {
    return wait_until_due(l.rings, [&] {
        if (finish_down_to(l, 0)) publish(l);
        return l.matrix_step >= 0 || l.rings.frame_head.load() < l.frames_begun;
    });
}

static bool begin(GpuLoop& l) {
    prctl(PR_SET_TIMERSLACK, 1000);  // ns: naps end when they should
    l.cpu = thread_time();
    CALL(context_set, l.context);
    return true;
}

// Waits, while matrices and mail come and go, until the batch under way is nearly over: what comes meanwhile goes with the next one.
// One that ends sooner than the last one did is noticed within `lead`.
static void await_mail(GpuLoop& l) {
    if (l.begun == l.finished || !exchanges(l)) return;
    const StepBatch& under_way = l.batches[l.finished % STEP_BATCHES];
    const double due = l.idle_since + l.step_seconds * under_way.steps - l.lead;
    for (double left; (left = due - now()) > 0 && !l.error && !done(l, under_way.done);) nap(std::min({left, l.lead, publish_meanwhile(l)}));
}

// Batches that may be under way while the next one is launched. One whose records have no place leaves none to those behind it.
static int64_t most_under_way(const GpuLoop& l) {
    const bool placed = l.begun == l.finished || l.batches[(l.begun - 1) % STEP_BATCHES].place >= 0;
    return l.rings.realtime || !placed ? 0 : STEP_BATCHES - 1;
}

extern "C" {

// Runs until `steps` are done or `stop` is set; returns the steps done. l.error is set if the device failed.
int64_t wf_gpu_run(GpuLoop* loop, int64_t steps) {
    GpuLoop& l = *loop;
    int64_t first = l.launched, left = steps;
    bool well = begin(l);
    while (well && left > 0) {
        well = finish_down_to(l, most_under_way(l));
        if (!well || !wait(l)) break;
        await_mail(l);
        int64_t size = l.rings.pause.load() ? 1 : batch_size(l, left);  // single steps
        well = launch_batch(l, size);
        left -= size;
    }
    if (well && finish_down_to(l, 0)) finish_readbacks(l);
    return l.rings.step - first;
}

int32_t wf_gpu_wait(GpuLoop* loop) { return wait(*loop); }

// One step whose kernels the caller launches, between `open` and `close`. `renew` reads the slots of settings and factors again, with
// nothing under way; these slots come first. Arguments of launches that have run wait for the next step.
int32_t wf_gpu_open(GpuLoop* loop) { return begin(*loop) && open_batch(*loop) && begin_matrices(*loop, true); }
int32_t wf_gpu_renew(GpuLoop* loop) { return deliver(*loop, loop->batches[loop->begun % STEP_BATCHES], 2 * loop->bodies); }
int32_t wf_gpu_close(GpuLoop* loop) {
    GpuLoop& l = *loop;
    return count(l, 1) && close_batch(l) && finish_down_to(l, 0) && finish_readbacks(l);
}

int32_t wf_gpu_take_changes(GpuLoop* loop) { return begin(*loop) && take_changes(*loop); }
DeviceChanges* wf_gpu_post_changes(GpuLoop* loop, DeviceChanges* changes) { return loop->changes.exchange(changes); }

// Posts mail into different slots, or takes back what is in them where `mail` is null. numbers: of the slots. displaced: of each, 1: what
// was there was not taken
void wf_gpu_post(GpuLoop* loop, int64_t count, const int64_t* numbers, Mail* mail, uint8_t* displaced) {
    for (int64_t k = 0; k < count; ++k)
        displaced[k] = loop->mail_slots[numbers[k]].posted.exchange(mail ? mail + k : nullptr) != nullptr;
    loop->posted.store(1, std::memory_order_release);
}

int32_t wf_launch_build(const CudaDriver* driver, const BuildLaunch* launch) { return launch_build(*driver, *launch); }

// Starts the balances of some bodies. starts: first node of each and the end of the last one. mass: of the nodes [kg]. x, v: of type
// double, or float where `single`. dt [s].
void wf_gpu_start_balances(int64_t count, const int64_t* bodies, Balance* balance, const int32_t* starts, const double* mass, const void* x,
                           const void* v, int32_t single, const double* gravity, double dt, int32_t inertia) {
    for (int64_t k = 0; k < count; ++k) {
        const int64_t body = bodies[k], first = starts[body], last = starts[body + 1];
        if (single) begin_balance(balance[body], first, last, mass, (const float*)x, (const float*)v, gravity, dt, inertia);
        else begin_balance(balance[body], first, last, mass, (const double*)x, (const double*)v, gravity, dt, inertia);
    }
}

const StructSize* wf_sizes() {
    static const StructSize sizes[] = {SIZE(CudaDriver), SIZE(Mail), SIZE(MailSlot), SIZE(RecordTarget), SIZE(StepTimestamp),
                                       SIZE(NewtonResult), SIZE(StageResult), SIZE(ContactResult), SIZE(SubstepResult), SIZE(BodyReadback), SIZE(GpuLoop), SIZE(Record),
                                       SIZE(Balance), SIZE(Reaction), SIZE(PairSum), SIZE(DeviceCopy), SIZE(CopyLaunch), SIZE(DeviceChanges), {}};
    return sizes;
}
}
