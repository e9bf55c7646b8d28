// What search and refinement share: one work group holds one sample's window; each of its lanes
// holds every LANES-th pixel. See `template` and `_normalise` of track/flow.py.
//
// Before this text stand SIDE, COLUMNS (the side in the CPU's memory, which decides how near the
// image's edge a window may come), LANES and the window's weights along one side, LINE[SIDE].
layout(local_size_x = LANES) in;
layout(std430, binding = 0) readonly buffer Reference { float reference[]; };
layout(std430, binding = 1) readonly buffer Gradient { float gradient[]; }; // by column, by row
layout(std430, binding = 2) readonly buffer Windows { uint windows[]; };    // bytes
layout(std430, binding = 3) readonly buffer View { float view[]; };
layout(std430, binding = 4) readonly buffer Solid { uint solid[]; }; // bytes
struct Sample {
    ivec4 place; // index in the level, column and row of the window's corner
    ivec2 shift; // whole pixels from which `solid` is read
    vec2 start;
};
layout(std430, binding = 5) readonly buffer Samples { Sample samples[]; };
struct Match {
    vec4 found; // displacement, correlation
    vec4 information;
};
layout(std430, binding = 6) writeonly buffer Matches { Match matches[]; };
uniform ivec2 size;
uniform int count;

const int PIXELS = SIDE * SIDE;
const int OWN = (PIXELS + LANES - 1) / LANES;
const int SUMS = 5;
const float FLAT = 1e-5;
const float MIN_PIXELS = 20.0;
const float NONE = -1.0;

shared float partial[SUMS * LANES];
shared float total[SUMS];

int group() { return int(gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x); }

int lane() { return int(gl_LocalInvocationID.x); }

void meet() {
    memoryBarrierShared();
    barrier();
}

// Every lane's parts become the sums over all lanes, the same in every lane.
void add_lanes(inout float part[SUMS]) {
    meet(); // the totals of last time have been read
    for (int q = 0; q < SUMS; ++q)
        partial[q * LANES + lane()] = part[q];
    meet();
    if (lane() < SUMS) {
        float sum = 0.0;
        for (int i = 0; i < LANES; ++i)
            sum += partial[lane() * LANES + i];
        total[lane()] = sum;
    }
    meet();
    for (int q = 0; q < SUMS; ++q)
        part[q] = total[q];
}

uint byte_of(uint word, int index) { return (word >> (8 * (index & 3))) & 255u; }

bool inside(ivec2 pixel) {
    return all(greaterThanEqual(pixel, ivec2(0))) && all(lessThan(pixel, size));
}

float near(ivec2 pixel) { // the view at a pixel, or at the one nearest to it
    ivec2 held = clamp(pixel, ivec2(0), size - 1);
    return view[held.y * size.x + held.x];
}

float share[OWN];  // of each pixel in the window's sums
float value[OWN];  // of the reference: zero mean, unit variance
vec2 slope[OWN];   // its gradient, freed of mean and gain

// Fill share, value and slope; false without texture.
bool hold_window(Sample own, bool slopes) {
    ivec2 corner = own.place.yz, middle = clamp(corner + SIDE / 2, ivec2(0), size - 1);
    float level = reference[middle.y * size.x + middle.x]; // keeps the sums small
    float sums[SUMS] = float[](0.0, 0.0, 0.0, 0.0, 0.0);
    for (int k = 0; k < OWN; ++k) {
        int pixel = lane() + k * LANES, i = pixel % SIDE, j = pixel / SIDE;
        int byte_at = own.place.x * PIXELS + pixel;
        ivec2 here = corner + ivec2(i, j), there = here + own.shift;
        share[k] = value[k] = 0.0;
        slope[k] = vec2(0.0);
        if (pixel >= PIXELS || byte_of(windows[byte_at >> 2], byte_at) == 0u || !inside(here))
            continue;
        sums[3] += 1.0;
        int at = there.y * size.x + there.x;
        if (!inside(there) || byte_of(solid[at >> 2], at) == 0u)
            continue;
        at = here.y * size.x + here.x;
        share[k] = LINE[i] * LINE[j];
        value[k] = reference[at] - level;
        if (slopes)
            slope[k] = vec2(gradient[at], gradient[at + size.x * size.y]);
        sums[0] += share[k];
        sums[1] += share[k] * value[k];
        sums[2] += 1.0;
    }
    add_lanes(sums);
    if (sums[2] < MIN_PIXELS || 2.0 * sums[2] < sums[3])
        return false;
    float whole = 1.0 / sums[0], mean = sums[1] / sums[0];
    sums = float[](0.0, 0.0, 0.0, 0.0, 0.0);
    for (int k = 0; k < OWN; ++k) {
        if (share[k] == 0.0)
            continue;
        share[k] *= whole;
        value[k] -= mean;
        sums[0] += share[k] * value[k] * value[k];
        sums[1] += share[k] * slope[k].x;
        sums[2] += share[k] * slope[k].y;
        sums[3] += share[k] * value[k] * slope[k].x;
        sums[4] += share[k] * value[k] * slope[k].y;
    }
    add_lanes(sums);
    if (sums[0] < FLAT)
        return false;
    float gain = 1.0 / sqrt(sums[0]);
    vec2 offset = vec2(sums[1], sums[2]), tilt = vec2(sums[3], sums[4]) * gain * gain;
    for (int k = 0; k < OWN; ++k) {
        slope[k] = (slope[k] - offset - tilt * value[k]) * gain;
        value[k] *= gain;
    }
    return true;
}
