// The frame's image brought into the reference by the motion field of the mesh: see track/guide.py.
//
// A vertex lies at `base + part` pixels, base whole: places are found relative to the base of the
// triangle's first corner, so that single precision keeps a place to a millionth of a pixel.
layout(local_size_x = 16, local_size_y = 4) in;
layout(std430, binding = 0) readonly buffer Triangle { int triangle[]; };  // of a pixel, -1: none
layout(std430, binding = 1) readonly buffer Weights { vec2 weights[]; };   // of corners 1 and 2
layout(std430, binding = 2) readonly buffer Corners { int corners[]; };    // 3 a triangle
struct Vertex { float base_x, base_y, part_x, part_y, depth; }; // depth 0: not to be drawn
layout(std430, binding = 3) readonly buffer Vertices { Vertex vertices[]; };
layout(std430, binding = 4) readonly buffer Reference { float reference[]; };
layout(std430, binding = 5) writeonly buffer Warped { float warped[]; };
layout(std430, binding = 6) writeonly buffer Place { uint place[]; }; // bits: NaN passes unharmed
layout(std430, binding = 7) writeonly buffer Shown { uint shown[]; };
layout(binding = 0) uniform sampler2D frame;
layout(binding = 1) uniform usampler2D occluders; // bits of depths: NaN is told by its bits
uniform ivec2 size;
uniform float scale; // of the occluders; 0: there are none

const uint NAN = 0x7fc00000u;
const float MARGIN_MM = 1.5;

vec4 cubic(float t) {
    float a0 = ((-0.5 * t + 1.0) * t - 0.5) * t;
    float a2 = ((-1.5 * t + 2.0) * t + 0.5) * t;
    float a3 = (0.5 * t - 0.5) * t * t;
    return vec4(a0, 1.0 - a0 - a2 - a3, a2, a3);
}

float interpolated(ivec2 corner, vec2 part) {
    vec4 across = cubic(part.x), along = cubic(part.y);
    float value = 0.0;
    for (int j = 0; j < 4; ++j) {
        vec4 line;
        for (int i = 0; i < 4; ++i)
            line[i] = texelFetch(frame, corner + ivec2(i - 1, j - 1), 0).r;
        value += along[j] * dot(across, line);
    }
    return value;
}

// Whether the deepest of the four depths around lies well before `depth`.
bool hidden(vec2 at, float depth) {
    ivec2 corner = ivec2(floor(at)), count = textureSize(occluders, 0);
    float deepest = -1e30;
    for (int j = 0; j < 2; ++j)
        for (int i = 0; i < 2; ++i) {
            ivec2 here = corner + ivec2(i, j);
            if (any(lessThan(here, ivec2(0))) || any(greaterThanEqual(here, count)))
                continue;
            uint bits = texelFetch(occluders, here, 0).r;
            if ((bits & 0x7fffffffu) > 0x7f800000u)
                return false;
            deepest = max(deepest, uintBitsToFloat(bits));
        }
    return depth > deepest + MARGIN_MM;
}

vec2 away(Vertex tip, Vertex root) {
    return vec2(tip.base_x - root.base_x, tip.base_y - root.base_y)
        + vec2(tip.part_x - root.part_x, tip.part_y - root.part_y);
}

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, size)))
        return;
    int index = pixel.y * size.x + pixel.x;
    uvec2 where = uvec2(NAN);
    float value = reference[index];
    uint seen = 0u;
    int drawn = triangle[index];
    if (drawn >= 0) {
        Vertex one = vertices[corners[3 * drawn]], two = vertices[corners[3 * drawn + 1]],
               three = vertices[corners[3 * drawn + 2]];
        vec2 share = weights[index];
        vec3 far = vec3(one.depth, two.depth, three.depth);
        if (far.x > 0.0 && far.y > 0.0 && far.z > 0.0) {
            vec3 pull = vec3(1.0 - share.x - share.y, share) * far;
            float depth = pull.x + pull.y + pull.z;
            vec2 base = vec2(one.base_x, one.base_y), from = vec2(one.part_x, one.part_y);
            vec2 part = from + (pull.y * away(two, one) + pull.z * away(three, one)) / depth;
            ivec2 corner = ivec2(base) + ivec2(floor(part));
            bool inside = all(greaterThanEqual(corner, ivec2(1)))
                && all(lessThan(corner, textureSize(frame, 0) - 2));
            if (inside) {
                vec2 at = base + part;
                where = floatBitsToUint(at);
                if (!(scale > 0.0 && hidden(at / scale, depth))) {
                    value = interpolated(corner, part - floor(part));
                    seen = 1u;
                }
            }
        }
    }
    warped[index] = value;
    place[2 * index] = where.x;
    place[2 * index + 1] = where.y;
    shown[index] = seen;
}
