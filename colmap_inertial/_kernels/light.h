// Linear light as an image: colours joined, blended with the image that was filtered, and written in its codes.
#pragma once

#include <cstddef>
#include <cstdint>

constexpr int CELL = 16;  // px, width and height of a cell

// The blur of an image.
struct Field {
    int ny, nx;           // cells
    const float *extent;  // (ny, nx) blur along the major axis, px
    const float *slope;   // (ny, nx) minor over major component
    const bool *along_y;  // (ny, nx) whether the major axis is y
    const float *fade;    // (ny + 1, nx + 1) share of the result at the corners
};

struct Codec {
    const float *decode;  // linear light of every code
    const float *encode;  // codes of evenly spaced light, encode_steps + 2 entries
    int encode_steps;
    int saturated;  // codes from here on are
};

struct Image {
    int height, width, channels;
};

// The codes of what a filter made of the image, as linear light. Where the blur is short, the result fades into the
// image; so it does near saturated pixels that are far brighter than the sensor can hold. Where its share is zero, the
// image's own codes stay. Code: uint8_t or uint16_t.
template <class Code>
void blend(const Code *image, const float *light, Code *result, Image size, const Field &field, const Codec &codec,
           int threads);

// Sets spoilt (height, width) to one where the result's share is zero because of such pixels; false where there are none,
// and spoilt stays as it is. The fade of the field is not read.
template <class Code>
bool find_spoilt(const Code *image, uint8_t *spoilt, Image size, const Field &field, const Codec &codec, int threads);

// result (height, width, 3) = linear light of (height, width) luma, whose shares of R - G and B - G are red and blue;
// lines: slopes and offsets of both over luma, each of half the size, rounded up.
void join(const float *luma, const float *lines, Image size, float red, float blue, float *result, int threads);

// The nearest codes of linear light.
void encode(const float *light, size_t count, uint8_t *result, const Codec &codec);
