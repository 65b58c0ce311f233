/* The default step of fusion_gym/TobitOscillator-v1 as a scalar loop, a reference for speed.

   cc -O3 -march=native oscillator.c -lm && ./a.out [runs] [steps]

   Plant, three censored sensors, the dynamic event trigger, the token bucket, the bound filter and
   the fusion of tobit_token_bucket (equations (1)-(37)); no observation and no reset. It prints the
   steps per second and the mean squared error. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

enum { SENSORS = 3 };
typedef double Matrix[4]; /* two rows */

typedef struct {
    double truth[2], mean[2], held[SENSORS][2], requested[SENSORS][2], variable[SENSORS], event_bound[SENSORS], tokens;
    Matrix covariance;
} Run;

static const double SIGMA[SENSORS] = {.1, .2, .3}, LAMBDA[SENSORS] = {.1, .2, .1}, CHI = 5;
static const double GAIN[2] = {.16, .18}, PROCESS_VARIANCE = .05, VARIANCE = .5;
static const double RATE = 5, CAPACITY = 30, COST = 3;
static Matrix transition, process;
static double kappa[9], growth, shift, xi_growth[SENSORS], xi_offset[SENSORS];

static double uniform(void) { /* xorshift64* in (0, 1) */
    static uint64_t state = 88172645463393265ull;
    state ^= state >> 12, state ^= state << 25, state ^= state >> 27;
    return ((state * 2685821657736338717ull >> 11) + .5) / 9007199254740992.0;
}

static double normal(void) { /* the polar method */
    static double second;
    static int stored;
    double u, v, square;
    if (stored) return stored = 0, second;
    do u = 2 * uniform() - 1, v = 2 * uniform() - 1, square = u * u + v * v;
    while (square >= 1);
    double factor = sqrt(-2 * log(square) / square);
    return stored = 1, second = v * factor, u * factor;
}

static void multiply(const Matrix a, const Matrix b, Matrix out) {
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 2; j++) out[2 * i + j] = a[2 * i] * b[j] + a[2 * i + 1] * b[2 + j];
}

static void congruence(const Matrix a, const Matrix middle, Matrix out) { /* a middle a' */
    const Matrix transposed = {a[0], a[2], a[1], a[3]};
    Matrix product;
    multiply(a, middle, product), multiply(product, transposed, out);
}

static void invert(const Matrix a, Matrix out) {
    double scale = 1 / (a[0] * a[3] - a[1] * a[2]);
    out[0] = a[3] * scale, out[1] = -a[1] * scale, out[2] = -a[2] * scale, out[3] = a[0] * scale;
}

/* The posterior of one node and its bound: equations (20)-(37). */
static void update(const double mean[2], const Matrix prior, const double value[2],
                   const double event_bound, int delivered, double out[2], Matrix bound) {
    double q[2], bias[2], expected[2], noise[4], moment[4], right[4], gain[4], inverse[4], left[4];
    for (int i = 0; i < 2; i++) {
        double limit = -mean[i] / sqrt(VARIANCE);
        q[i] = fmax(.5 * erfc(limit * M_SQRT1_2), 1e-290);
        bias[i] = exp(-.5 * limit * limit) / sqrt(2 * M_PI) * sqrt(VARIANCE);
        expected[i] = q[i] * mean[i] + bias[i];
    }
    for (int k = 0; k < 4; k++) {
        int i = k / 2, j = k % 2;
        moment[k] = growth * prior[k] + shift * mean[i] * mean[j];
        noise[k] = kappa[2] * bias[i] * bias[j];
        if (!delivered) noise[k] += kappa[4] * q[i] * q[j] * moment[k] + kappa[5] * value[i] * value[j];
        else if (i == j) noise[k] += q[i] * VARIANCE + q[i] * (1 - q[i]) * kappa[3] * moment[k]
                                     + kappa[6] * event_bound;
        right[k] = kappa[1] * prior[k] * q[j];
        left[k] = kappa[1] * q[i] * prior[k] * q[j] + noise[k];
    }
    invert(left, inverse), multiply(right, inverse, gain);
    Matrix error = {1 - gain[0] * q[0], -gain[1] * q[1], -gain[2] * q[0], 1 - gain[3] * q[1]};
    congruence(error, prior, bound), congruence(gain, noise, left);
    for (int i = 0; i < 2; i++) {
        out[i] = mean[i];
        for (int j = 0; j < 2; j++) out[i] += gain[2 * i + j] * (value[j] - expected[j]);
    }
    for (int k = 0; k < 4; k++) bound[k] = kappa[1] * bound[k] + left[k];
}

static double step(Run *run) {
    double information[4] = {0}, vector[2] = {0}, prior_mean[2], noise = normal() * sqrt(PROCESS_VARIANCE);
    double moved[2], measurement[SENSORS][2];
    Matrix prior, bound, inverse;
    int requested[SENSORS], sent = 0;
    for (int i = 0; i < 2; i++) {
        moved[i] = transition[2 * i] * run->truth[0] + transition[2 * i + 1] * run->truth[1] + GAIN[i] * noise;
        prior_mean[i] = transition[2 * i] * run->mean[0] + transition[2 * i + 1] * run->mean[1];
    }
    run->truth[0] = moved[0], run->truth[1] = moved[1];
    congruence(transition, run->covariance, prior);
    for (int k = 0; k < 4; k++) prior[k] = SENSORS * (prior[k] + process[k]);
    for (int s = 0; s < SENSORS; s++) {
        double distance = 0;
        for (int i = 0; i < 2; i++) {
            measurement[s][i] = fmax(run->truth[i] + sqrt(VARIANCE) * normal(), 0);
            distance += pow(run->requested[s][i] - measurement[s][i], 2);
        }
        distance = sqrt(distance);
        requested[s] = distance >= run->variable[s] / CHI + SIGMA[s];
        run->variable[s] = fmax(LAMBDA[s] * run->variable[s] + SIGMA[s] - (requested[s] ? 0 : distance), 0);
        if (requested[s]) run->requested[s][0] = measurement[s][0], run->requested[s][1] = measurement[s][1];
        run->event_bound[s] = xi_growth[s] * run->event_bound[s] + xi_offset[s];
    }
    int affordable = COST * SENSORS <= run->tokens;
    for (int s = 0; s < SENSORS; s++) {
        int delivered = requested[s] && affordable;
        double own[2];
        sent += delivered;
        if (delivered) run->held[s][0] = measurement[s][0], run->held[s][1] = measurement[s][1];
        update(prior_mean, prior, run->held[s], run->event_bound[s], delivered, own, bound);
        invert(bound, inverse);
        for (int k = 0; k < 4; k++) information[k] += inverse[k];
        for (int i = 0; i < 2; i++) vector[i] += inverse[2 * i] * own[0] + inverse[2 * i + 1] * own[1];
    }
    run->tokens = fmin(run->tokens + RATE - COST * sent, CAPACITY);
    invert(information, run->covariance);
    double error = 0;
    for (int i = 0; i < 2; i++) {
        run->mean[i] = run->covariance[2 * i] * vector[0] + run->covariance[2 * i + 1] * vector[1];
        error += pow(run->truth[i] - run->mean[i], 2);
    }
    return error;
}

int main(int count, char **values) {
    int runs = count > 1 ? atoi(values[1]) : 1024, steps = count > 2 ? atoi(values[2]) : 100;
    double e[15], d = 1.5, f = 2, angle = .052 * M_PI, total = 0;
    for (int i = 1; i < 15; i++) e[i] = i < 6 ? .05 : i < 14 ? .7 : 1;
    double constants[9] = {0, 1 + e[1] + e[2] + e[3] + e[4] + e[5],
        1 + 1 / e[1] + 1 / e[7] + 1 / e[10] + 1 / e[12] + 1 / e[13], 1 + e[6],
        1 + e[7] + e[8] + e[9] + 1 / e[2], 1 + 1 / e[3] + 1 / e[8] + e[10] + e[11],
        1 + 1 / e[4] + e[12], 1 + 1 / e[5] + 1 / e[9] + 1 / e[11] + e[13], 1 + 1 / e[6]};
    for (int i = 0; i < 9; i++) kappa[i] = constants[i];
    growth = 1 + e[14], shift = 1 + 1 / e[14];
    transition[0] = transition[3] = cos(angle), transition[1] = sin(angle), transition[2] = -sin(angle);
    for (int k = 0; k < 4; k++) process[k] = GAIN[k / 2] * GAIN[k % 2] * PROCESS_VARIANCE;
    for (int s = 0; s < SENSORS; s++) {
        xi_growth[s] = (1 + d) * (1 + f) * LAMBDA[s] * LAMBDA[s] + (1 + CHI) * (1 + 1 / d) / (CHI * CHI);
        xi_offset[s] = ((1 + d) * (1 + 1 / f) + (1 + 1 / d) * (1 + 1 / CHI)) * SIGMA[s] * SIGMA[s];
    }
    Run *all = calloc(runs, sizeof *all);
    for (int r = 0; r < runs; r++) {
        all[r].truth[0] = all[r].mean[0] = 5, all[r].tokens = 10;
        all[r].truth[0] += sqrt(.1) * normal(), all[r].truth[1] += sqrt(.1) * normal();
        all[r].covariance[0] = all[r].covariance[3] = .1;
        for (int s = 0; s < SENSORS; s++) {
            all[r].variable[s] = 1.5, all[r].event_bound[s] = 2.25;
            for (int i = 0; i < 2; i++)
                all[r].held[s][i] = all[r].requested[s][i] = fmax(all[r].truth[i] + sqrt(VARIANCE) * normal(), 0);
        }
    }
    clock_t began = clock();
    for (int t = 0; t < steps; t++)
        for (int r = 0; r < runs; r++) total += step(&all[r]);
    double seconds = (double)(clock() - began) / CLOCKS_PER_SEC;
    printf("%.6g %.6g\n", runs * (double)steps / seconds, total / runs / steps);
    free(all);
    return 0;
}
