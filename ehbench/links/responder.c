/* A target in C: what a rig's computer does with the datagrams of ehbench.
   Fill in read_sensors and write_valves; ehb_wire.h comes from: ehbench wire RIG --c --out DIR
   cc -std=c99 -O2 -Wall -o responder responder.c -lm && ./responder 47000
   A datagram is a vector of little-endian float64: eight header numbers, then values. */
#define _POSIX_C_SOURCE 200809L
#include <arpa/inet.h>
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>
#include "ehb_wire.h"

enum { LAYOUT, TOKEN, SEQUENCE, TIME, ACKNOWLEDGED, STATE, REASON, WATCHDOG_S, HEADER };
enum { IDLE, ALIVE, ARMED, RUNNING, STOPPING, STOPPED };
enum { NONE, DONE, HOST, WATCHDOG, NOT_FINITE, DISAGREEMENT };
enum { DOWN = HEADER + EHB_COMMANDS, UP = HEADER + EHB_SAMPLE + EHB_COMMANDS, TOKENS = 4096 };
static double WATCHDOG_TIME = 0.02; /* [s], or the second word of the command line */
static const double RAMP = 0.05, QUIET = 0.5, PATIENCE = 1.0; /* [s] */

static int state = IDLE, reason = NONE, ramped = 0, used_count = 0;
static double token = 0.0, sequence = 0.0, acknowledged = 0.0, heard = 0.0, gapless = 0.0;
static double wanted[EHB_COMMANDS], applied[EHB_COMMANDS], used[TOKENS];

static void read_sensors(double *values) /* [SI], in the order of the layout */
{
    for (int i = 0; i < EHB_SAMPLE; i++) values[i] = 0.0;
}

static void write_valves(const double *commands) /* [V] */
{
    (void)commands;
}

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void stop(int why) /* the valves go to rest; latched until a new token comes */
{
    state = state == RUNNING ? STOPPING : STOPPED;
    reason = why;
    ramped = 0;
}

static int counts(const double *in, long size) /* whether a datagram is for us, and new */
{
    if (size != 8 * HEADER && size != 8 * DOWN) return 0;
    for (int i = 0; i < HEADER; i++)
        if (!isfinite(in[i])) return 0;
    int bare = size == 8 * HEADER && (in[STATE] == ALIVE || in[STATE] == STOPPING);
    if (size == 8 * HEADER && !bare) return 0;
    if (in[LAYOUT] != EHB_LAYOUT_STREAM && !(bare && in[LAYOUT] == 0.0)) return 0;
    if (in[TOKEN] == token) return in[SEQUENCE] > acknowledged;
    if (state == ARMED || state == RUNNING || state == STOPPING) return 0;
    for (int i = 0; i < used_count; i++)
        if (used[i] == in[TOKEN]) return 0;
    return used_count < TOKENS;
}

static int receive(const double *in, long size, double t)
{
    if (!counts(in, size)) return 0;
    if (in[TOKEN] != token) { /* a new session; it ends a stop */
        used[used_count++] = token;
        token = in[TOKEN];
        gapless = t;
        state = ALIVE;
        reason = NONE;
        memcpy(wanted, EHB_REST, sizeof wanted);
    } else if (t - heard > WATCHDOG_TIME) {
        gapless = t;
    }
    acknowledged = in[SEQUENCE];
    heard = t;
    if (state >= STOPPING) return 1;
    for (int i = 0; size == 8 * DOWN && i < EHB_COMMANDS; i++) {
        if (!isfinite(in[HEADER + i])) return stop(NOT_FINITE), 1;
        wanted[i] = in[HEADER + i];
    }
    int wish = (int)in[STATE];
    if (wish == STOPPING) stop(in[REASON] > 0.0 ? (int)in[REASON] : HOST);
    else if (wish != state && !(wish == state + 1 && wish <= RUNNING) && !(state == IDLE && wish == ALIVE))
        stop(DISAGREEMENT);
    else if (wish != ARMED || state == ARMED || t - gapless >= QUIET) state = wish;
    return 1;
}

static void tick(double *out, double t)
{
    double silence = t - heard, before[EHB_COMMANDS];
    if (silence > (state == RUNNING ? WATCHDOG_TIME : PATIENCE)) {
        if (state == ARMED || state == RUNNING) stop(WATCHDOG);
        else if (state == ALIVE) state = IDLE;
    }
    memcpy(before, applied, sizeof before);
    int left = (int)(RAMP * EHB_RATE + 0.5) - ramped++;
    for (int i = 0; i < EHB_COMMANDS; i++) {
        double next = EHB_REST[i], step = EHB_CHANGE[i] / EHB_RATE;
        if (state == RUNNING) next = wanted[i];
        if (state == STOPPING && left > 1) next = before[i] + (next - before[i]) / left;
        next = fmin(fmax(next, fmax(EHB_LOWEST[i], before[i] - step)), before[i] + step);
        applied[i] = fmin(next, EHB_HIGHEST[i]);
    }
    if (state == STOPPING && left <= 1) state = STOPPED;
    sequence += 1.0;
    double header[] = {EHB_LAYOUT_STREAM, token, sequence, t, acknowledged, state, reason, WATCHDOG_TIME};
    memcpy(out, header, sizeof header);
    read_sensors(out + HEADER);
    write_valves(applied);
    memcpy(out + HEADER + EHB_SAMPLE, before, sizeof before); /* what acted up to this sample */
}

int main(int count, char **words)
{
    struct sockaddr_in place = {.sin_family = AF_INET}, sender, peer;
    int link = socket(AF_INET, SOCK_DGRAM, 0), known = 0;
    double in[512], out[UP], due = now();
    place.sin_port = htons((unsigned short)(count > 1 ? atoi(words[1]) : 47000));
    place.sin_addr.s_addr = htonl(INADDR_ANY);
    if (bind(link, (struct sockaddr *)&place, sizeof place) != 0) return perror("bind"), 1;
    fcntl(link, F_SETFL, O_NONBLOCK);
    memcpy(applied, EHB_REST, sizeof applied);
    if (count > 2) WATCHDOG_TIME = atof(words[2]);
    for (;;) {
        struct timespec pause = {0, 0};
        if (due > now()) pause.tv_nsec = (long)(1e9 * fmin(due - now(), 0.9));
        if (pause.tv_nsec > 0) nanosleep(&pause, NULL);
        for (;;) {
            socklen_t length = sizeof sender;
            long size = recvfrom(link, in, sizeof in, 0, (struct sockaddr *)&sender, &length);
            if (size < 0) break;
            int busy = state == ARMED || state == RUNNING || state == STOPPING;
            if (busy && memcmp(&sender, &peer, sizeof peer) != 0) continue;
            if (receive(in, size, now())) peer = sender, known = 1;
        }
        tick(out, now());
        if (known && state != IDLE) sendto(link, out, sizeof out, 0, (struct sockaddr *)&peer, sizeof peer);
        due = fmax(due + 1.0 / EHB_RATE, now() - 0.1);
    }
}
