// Whole-pixel displacement of highest correlation: one work group a sample, lanes take offsets.
// See `_search` of track/flow.py; of equal correlations the first in reading order wins.
uniform int radius;
uniform float aligned;

shared vec2 weighted[PIXELS]; // share, share * value
shared float best_score[LANES];
shared int best_offset[LANES];

float correlation(float mean, float square, float cross_sum) {
    float variance = square - mean * mean;
    return variance < FLAT ? NONE : cross_sum / sqrt(variance);
}

// By all lanes together, where the guide puts the window.
float guided(ivec2 corner, float level) {
    float sums[SUMS] = float[](0.0, 0.0, 0.0, 0.0, 0.0);
    for (int k = 0; k < OWN; ++k) {
        if (share[k] == 0.0)
            continue;
        int pixel = lane() + k * LANES;
        float seen = view[(corner.y + pixel / SIDE) * size.x + corner.x + pixel % SIDE] - level;
        sums[0] += share[k] * seen;
        sums[1] += share[k] * seen * seen;
        sums[2] += share[k] * seen * value[k];
    }
    add_lanes(sums);
    return correlation(sums[0], sums[1], sums[2]);
}

// By one lane, at one offset.
float shifted(ivec2 corner, float level) {
    float mean = 0.0, square = 0.0, cross_sum = 0.0;
    for (int j = 0; j < SIDE; ++j) {
        int row = (corner.y + j) * size.x + corner.x;
        for (int i = 0; i < SIDE; ++i) {
            vec2 pixel = weighted[j * SIDE + i];
            float seen = view[row + i] - level, part = pixel.x * seen;
            mean += part;
            square += part * seen;
            cross_sum += pixel.y * seen;
        }
    }
    return correlation(mean, square, cross_sum);
}

// The best of all offsets: correlation, and its number in reading order; -1 is the guide's place.
void search(ivec2 corner, float level, inout float best, inout int offset) {
    for (int k = 0; k < OWN; ++k)
        if (lane() + k * LANES < PIXELS)
            weighted[lane() + k * LANES] = share[k] * vec2(1.0, value[k]);
    meet();
    int across = 2 * radius + 1;
    float mine = best;
    int which = -1;
    for (int number = lane(); number < across * across; number += LANES) {
        ivec2 move = ivec2(number % across, number / across) - radius;
        float score = shifted(corner + move, level);
        if (score > mine) {
            mine = score;
            which = number;
        }
    }
    best_score[lane()] = mine;
    best_offset[lane()] = which;
    meet();
    for (int i = 0; i < LANES; ++i) {
        bool sooner = best_score[i] == best && best_offset[i] >= 0 && best_offset[i] < offset;
        if (best_score[i] > best || sooner) {
            best = best_score[i];
            offset = best_offset[i];
        }
    }
}

void main() {
    if (group() >= count)
        return;
    Sample own = samples[group()];
    ivec2 corner = own.place.yz;
    ivec2 low = corner - radius, high = corner + ivec2(COLUMNS, SIDE) + radius;
    if (any(lessThan(low, ivec2(0))) || any(greaterThan(high, size)) || !hold_window(own, false)) {
        if (lane() == 0)
            matches[group()].found = vec4(0.0, 0.0, NONE, 0.0);
        return;
    }
    float level = near(corner + SIDE / 2), best = guided(corner, level);
    int offset = -1, across = 2 * radius + 1;
    if (best <= aligned)
        search(corner, level, best, offset);
    if (lane() == 0) {
        ivec2 move = offset < 0 ? ivec2(0) : ivec2(offset % across, offset / across) - radius;
        matches[group()].found = vec4(vec2(move), best, 0.0);
    }
}
