// SPDX-License-Identifier: MIT
// Memory of the simulation loop (loop.cpp). structs.py reads their layouts.
#pragma once
#include "energy_balance.cuh"
#include "pcg.h"
#include "newton_line_search.cuh"
#include "rigid_motion.h"
#include "stable_step.cuh"
#include "step_form.h"

typedef void (*Kernel)(const void* params, int begin, int end);
typedef int (*React)(const void* params, long long step, Reaction* out);  // effects/touch.cu

struct Binding {           // arguments of a launch, replaceable between steps
    const void* params;
    int32_t items;
    int64_t taken;   // steps completed when the loop took it up, -1: it has not
};

struct Copy {              // new contents of an array that kernels read
    void* target;
    const void* source;
    int64_t bytes;
};

struct Changes {           // of parameters: copies that are made between the same two steps
    const Copy* copies;
    int32_t count;
    std::atomic<int64_t> taken;   // steps completed when the loop made them, -1: it has not
};

struct Launch {
    Kernel kernel;
    Binding* binding;
    std::atomic<Binding*> mail;   // the next one, or null
    const int32_t* parts;         // (bodies + 1,) items of each body, or null: not told apart
};

struct Body {
    int32_t first, last;                // nodes
    SolveSettings settings;             // as wanted, written from outside at any time
    SolveSettings now;                  // of the step under way
    const Factor* factor;               // in use
    std::atomic<const Factor*> mail;    // a newer one, or null
    std::atomic<double*> snapshot;      // where to copy the values of A, or the positions, or null
    std::atomic<int64_t> snapshot_step; // step of the last copy made, -1: none
    double ahead;                       // s: below 0 the copy is of A, else of x + ahead v
    int64_t steps;                      // solved so far
    Correction correction;
};

struct Newton {                        // several linearizations a step (newton.h)
    Limits most;
    double dx_dv;                      // dx / dv [s]
    const double* rotation;            // (nodes, 3, 3)
    const double* mass;                // (nodes,) in A [kg]
    const double* beta;                // (nodes,) [s]
    double *predictor, *damping_velocity, *inertial_increment;  // (nodes, 3) [m/s]
    double* room;                      // 18 doubles a node
    Search* search;                    // (bodies,)
    int32_t detect, detects;           // first and number of the launches that detect contacts, once a step (newton_contact.h)
    const int32_t* late;               // (launches,) 1: makes blocks of A that no trial needs, only the next linearization
    double forces_seconds, blocks_seconds;  // of the launches that are not late, and of those that are, as they ran last; 0: not yet
    double* moved;                     // (nodes, 3) predictor of contact: from the start of the step to the state reached; null: none
    int32_t* most_touching;            // (bodies,) most linearizations of a body whose search has contact in it, else 0
    int32_t* entered;                  // (bodies,) 1: a sweep of the step's paths has given it rows
};

struct StageState {                    // of a body in the step under way (rosenbrock.h)
    int32_t form;                      // StepForm of the attempt, or FAILED
    int32_t accepted;                  // 1: the attempt is the step
    int32_t assembled;                 // 1: A is that of the step
    int32_t corrects;                  // 1: the factor is corrected for grabs
    int32_t misses;                    // 1: it is not, though it should be
    int32_t free;                      // 1: nothing holds the body in the step (momentum.h)
    MomentumSums missing;              // impulses of both stages (rigid_motion.h)
    int32_t patience;                  // steps to come that iterate
    int64_t factor_step;               // of the last factor
    int32_t of_euler;                  // 1: it is of backward Euler, and cannot stand for A
    int64_t euler_step;                // last step in which copies of A were to be of backward Euler, -1: none
    uint64_t euler_copies;             // bit k: they were k steps ago
    double estimate;                   // of the last attempt by stages [m]
    SolveResult result;                // of all solves of the step
};

constexpr int FAILED = -1;             // form of an attempt that gave no state

struct Stages {                        // input of the Rosenbrock-W step
    const int32_t *first, *again, *end;  // numbers of launches: the forces of both stages; after the second
    int32_t firsts, agains, ends;
    int32_t second, finish, prepare, remember, restore;  // likewise
    int32_t factor_alone;              // 1: wanted
    const double* estimate;            // (nodes,) of the last attempt [m]
    const double* bound;               // (bodies,) [m]
    const double *mass, *share, *weight, *diagonal;  // (nodes,) of the first stage's check (step_form.h): M, theta, w, of A
    const double *start_x, *start_v, *b, *inertial_increment;  // (nodes, 3) of the momenta; b: world frame (momentum.h)
    const int32_t* unheld;             // (bodies,) 1: no node is fixed
    int32_t* held_moves;               // (bodies,) 1: a holder moves in the step; set before the forces of the first stage
    double* first_stage;               // (nodes, 9) start of the solve, b and y of the first stage
    StageState* state;                 // (bodies,)
};

struct EulerForm {                     // steps of backward Euler in scenes of other schemes (euler_form.h)
    const int32_t* launch;             // numbers of launches that assemble them
    int32_t launches;
    int32_t detect, detects;           // first and number of the launches that detect contacts
    const int32_t* settle;             // numbers of launches after the solve, that make the forces on holders
    int32_t settles;
    int32_t restore, advance;          // numbers of launches: back to the start of the step; the end of it
    double* coefficients;              // (2,) of launches whose arguments change while steps run
    double own_coefficients[2], euler_coefficients[2];
    double *start_x, *start_v;         // (nodes, 3) at the start of the step
    const double* before;              // (nodes, 3) x at the start of the last step
    double* earlier;                   // (nodes, 3) and of the one before
    double* end_x;                     // (nodes, 3) of bodies whose step is made
    double* solution;                  // (nodes, 3) of the last step by backward Euler, world frame
    const double* diagonal;            // (nodes,) of A [kg]
    const double* block_scale;         // (bodies,) of K in A of backward Euler over that of the scheme
    int32_t* takes;                    // (bodies,) 1: the body takes this step by backward Euler
    int32_t* touching;                 // (bodies,) steps in a row in which it has touched something from the start
    int32_t* assembled;                // (bodies,) 1: A is that of the step of the scheme
    SolveResult* result;               // (bodies,) of the step, without stages
};

struct CentralDifference {             // steps by explicit substeps (central_difference.h)
    int32_t held;                      // launches that assemble and run once a step, before the others: motion of holders
    int32_t remember, keep, displace, open, shift, kick, close;  // numbers of launches
    double *substep, *shift_time;      // (1,) [s]
    const double *mass, *free;         // (nodes,)
    double* force;                     // (nodes, 3) of the last evaluation [N]
    const double *kept_x, *kept_force; // (nodes, 3) [m], [N]
    double* mode;                      // (nodes, 3) displacement that forces are differentiated along [m]
    int32_t* failed;                   // (bodies,) 1: the step gave no state
    StableStep* stable;                // (bodies,)
    SolveResult* result;               // (bodies,)
    SubstepState state;
};

struct Elastic {                       // potential energies of the elements of an effect
    Launch launch;
    const double* energy;              // (items,) out [J]
    const int32_t* parts;              // (bodies + 1,) items of each body
};

struct Energies {                      // energy.h
    const double* gravity;             // (3,) [m/s2]
    const double* mass;                // (nodes,) [kg]
    const double* before;              // (nodes, 3) x when the step began [m]
    double *force, *spring, *anchor;   // of hands (effects/touch.cu); null: nothing can be touched
    const double* load;                // (nodes, 3) of the effects with loads (effects/_loads.py), or null
    double* free;                      // (nodes,) 0 from when a body is frozen
    double** still;                    // arrays (nodes, 3) that are 0 then
    Elastic* elastic;
    Balance* balance;                  // (bodies,)
    double* left;                      // (2, nodes, 3) x and v when the loop was left
    int32_t stills, elastics, on_runaway, inertia;
    int32_t begun;                     // the energy before the first step is known
};

struct ShortSteps {                    // of a body that ran away (halving.h)
    int32_t level;                     // its steps are made of 2^level short ones
    int32_t left;                      // for so many steps to come; below 0: the elastic energy does not count for so many
    int32_t patience;                  // and for so many when it ran away last
    int32_t calm;                      // steps without since
};

struct Halving {                       // halving.h
    int32_t levels, launches;          // most halvings; launches that assemble a short step
    const int32_t* launch;             // (levels, launches) their numbers
    const int32_t* advance;            // (levels,) number of the launch that ends it
    int32_t end;                       // number of the launch that begins the next step of the scheme; -1: there is nothing to begin
    double* coefficients;              // (2,) of launches whose arguments change while steps run
    double own_coefficients[2];
    double *start_x, *start_v;         // (nodes, 3) at the start of the step
    double* before;                    // (nodes, 3) gets x when the step begins
    double *predictor, *damping_velocity, *inertial_increment;  // (nodes, 3), or null: the scheme is backward Euler
    const double* rotation;            // (nodes, 3, 3)
    double** array;                    // (arrays,) (nodes, width) that a step leaves
    const int32_t* width;              // (arrays,) 3 or 1
    int32_t arrays;
    int32_t* touched;                  // (1,) body that alone pushes and grabs act on; -1: all
    double* room;                      // (arrays, nodes, 3)
    ShortSteps* state;                 // (bodies,)
    int32_t* made;                     // (bodies,) halvings of the step
    SolveResult* result;               // (bodies,) of its short steps
};

struct Loop {
    int32_t launches, before;          // launches; how many of them assemble (the others integrate)
    Launch* launch;
    const Launch* touch;               // pushes and grabs, or null
    const Launch* spawn;               // begins copies of nodes after parameters have changed, or null
    const int32_t* of_blocks;          // with it, numbers of launches over the blocks above the diagonal, whose number changes
    int32_t blocks_launches;
    const int32_t* history;            // numbers of launches that begin every step, once
    int32_t histories;
    int64_t advanced;                  // steps completed when they ran last, -1: they have not
    React react;
    int32_t bodies, nodes;
    Body* body;
    const int32_t* row_start;
    const int32_t* columns;
    const double* values;
    const RankOne* rank_one;           // parts of A beside its blocks, or null
    const double* b;                   // (nodes, 3) right-hand side in the material frame
    double* y;                         // (nodes, 3) start in, solution out
    double* x;                         // (nodes, 3) for frames
    double* v;
    double* work;                      // WORK doubles a node
    Newton* newton;                    // null: one linearization a step
    Stages* stages;                    // null: another scheme
    EulerForm* euler;                  // null: all bodies take the steps of the scheme
    Contact* contact;                  // null: nothing can be touched
    CentralDifference* substeps;       // null: an implicit scheme
    int32_t holders;
    const double* held_reaction;       // (bodies, holders, 6) force [N] and torque [N m] on each; launches that integrate set it
    double** measured;                 // where the numbers are that records come with, or null
    const int32_t* measured_first;     // (bodies + 1,) of each body
    Halving* halving;                  // null: a body that runs away is frozen, or goes on
    double* clock;                     // (1,) s, read by kernels
    int32_t* moving;                   // (bodies,) 0: the body rests (kernels/nodes.cu)
    Energies* energies;                // or null
    int32_t threads;                   // of this process, for launches and bodies
    double assemble_begin;
    double assemble_seconds;
    double cpu_begin;
    std::atomic<Changes*> changes;     // of parameters, or null
    Rings rings;
};

static BlockCsr matrix_of(const Loop& loop, const Body& body) {
    return {body.first, body.last, loop.row_start, loop.columns, loop.values, nullptr, loop.rank_one, (int)(&body - loop.body), loop.threads};
}

// f(number) for [0, count), of which each is about one body: those with much of all the nodes come one after another, as what is done
// for them is itself shared out between threads, and then the others side by side.
template <class B, class F> static void each_about_a_body(const Loop& loop, int count, B body_of, F f) {
    if (loop.threads < 2 || count < 2) {
        for (int k = 0; k < count; ++k) f(k);
        return;
    }
    auto is_large = [&](int k) {
        const Body& body = loop.body[body_of(k)];
        const int nodes = body.last - body.first;
        return nodes >= 2 * NODES_OF_A_THREAD && (int64_t)nodes * loop.threads >= loop.nodes;
    };
    bool small = false;
    for (int k = 0; k < count; ++k) {
        if (is_large(k)) f(k);
        else small = true;
    }
    if (!small) return;
    Team::each(loop.threads, count, [&](int k) { if (!is_large(k)) f(k); });
}
template <class F> static void each_body(const Loop& loop, F f) {
    each_about_a_body(loop, loop.bodies, [](int k) { return k; }, f);
}

// Runs a launch for the items [first, last).
static void run_items(const Launch& l, int64_t first, int64_t last, int threads) {
    const int64_t items = last - first, grain = 256;
    int parts = (int)(items / grain < threads ? items / grain : threads);
    if (parts < 2) {
        if (items > 0) l.kernel(l.binding->params, (int)first, (int)last);
        return;
    }
    Team::run(parts, [&](int k, int parts) {
        l.kernel(l.binding->params, (int)(first + items * k / parts), (int)(first + items * (k + 1) / parts));
    });
}
static void run(const Launch& l, int threads) { run_items(l, 0, l.binding->items, threads); }
