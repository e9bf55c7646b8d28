// Which pixels are shown with their four neighbours; four pixels, as bytes, a word.
layout(local_size_x = 64) in;
layout(std430, binding = 0) readonly buffer Shown { uint shown[]; };
layout(std430, binding = 1) writeonly buffer Solid { uint solid[]; };
uniform ivec2 size;

uint at(int index) {
    int x = index % size.x, y = index / size.x;
    if (x < 1 || y < 1 || x >= size.x - 1 || y >= size.y - 1)
        return 0u;
    return shown[index] & shown[index - 1] & shown[index + 1] & shown[index - size.x]
        & shown[index + size.x];
}

void main() {
    int words = (size.x * size.y + 3) / 4, stride = int(gl_NumWorkGroups.x * gl_WorkGroupSize.x);
    for (int word = int(gl_GlobalInvocationID.x); word < words; word += stride)
        solid[word] = at(4 * word) | at(4 * word + 1) << 8 | at(4 * word + 2) << 16
            | at(4 * word + 3) << 24;
}
