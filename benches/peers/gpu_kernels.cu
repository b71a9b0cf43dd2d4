// CUDA kernels for CuPy: density on a dense grid, and marching cubes. A baseline for our GPU stages.
//
// Lengths are in units of the spacing, from the first grid point. Grid points are numbered with z fastest. The sides of the
// grid are multiples of 8, and its outermost layer is outside. The formulas are ours (smoothness 1.25, cut-off at 0.01).

#define A 1.25f
#define EPS 0.01f
#define TAIL 4.605170186f                            // ln(1 / EPS)
#define END (1.0f + TAIL / A)                        // end of the support, in squared radii
#define SCALE (1.0f / (1.0f - EPS * (1.0f + TAIL)))
#define K (A * 1.442695041f)                         // exp(-A u) is exp2(-K u)
#define HELD 96                                      // atoms in shared memory of a block
#define LANES 64

struct Held {
    float4 atom[HELD];
    float u[HELD][8];
    float e[HELD][8];
};

// Adds the atoms in shared memory to eight grid points along z. Called by all threads of the block.
__device__ void add(Held& held, int n, float x, float y, float z, int lane, float* sum) {
    for (int s = lane; s < n * 8; s += LANES) {
        float d = z + (float)(s & 7) - held.atom[s >> 3].z;
        float u = d * d * held.atom[s >> 3].w;
        held.u[s >> 3][s & 7] = u;
        held.e[s >> 3][s & 7] = exp2f(-K * u);
    }
    __syncthreads();
    for (int c = 0; c < n; ++c) {
        float4 a = held.atom[c];
        float uxy = ((x - a.x) * (x - a.x) + (y - a.y) * (y - a.y)) * a.w;
        if (uxy >= END) continue;
        float e = exp2f(K * (1.0f - uxy)) * SCALE;
        float base = EPS * (1.0f + A * (END - uxy)) * SCALE;
#pragma unroll
        for (int k = 0; k < 8; ++k) {
            float u = held.u[c][k];
            sum[k] += uxy + u < END ? e * held.e[c][k] - base + EPS * A * SCALE * u : 0.0f;
        }
    }
    __syncthreads();
}

// One block of 64 threads per brick of 8 x 8 x 8 grid points, one thread per column along z. Atoms (x, y, z, 1/r^2) are sorted
// by brick. `starts` has the first atom of each brick, and the number of atoms at the end. `reach` is in bricks.
extern "C" __global__ void field(const float4* atoms, const int* starts, int bx, int by, int bz, int reach, float* out) {
    __shared__ Held held;
    __shared__ int count;
    int lane = threadIdx.x;
    int brick = blockIdx.x;
    int Z = brick % bz, Y = brick / bz % by, X = brick / bz / by;
    float low[3] = {8.0f * X, 8.0f * Y, 8.0f * Z};
    float x = low[0] + (float)(lane >> 3), y = low[1] + (float)(lane & 7);
    float sum[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    if (lane == 0) count = 0;
    __syncthreads();
    int z0 = max(Z - reach, 0), z1 = min(Z + reach, bz - 1);
    for (int i = max(X - reach, 0); i <= min(X + reach, bx - 1); ++i) {
        for (int j = max(Y - reach, 0); j <= min(Y + reach, by - 1); ++j) {
            int stop = starts[(i * by + j) * bz + z1 + 1];
            for (int at = starts[(i * by + j) * bz + z0]; at < stop; at += LANES) {
                if (at + lane < stop) {
                    float4 a = atoms[at + lane];
                    float dx = fmaxf(fmaxf(low[0] - a.x, a.x - low[0] - 7.0f), 0.0f);
                    float dy = fmaxf(fmaxf(low[1] - a.y, a.y - low[1] - 7.0f), 0.0f);
                    float dz = fmaxf(fmaxf(low[2] - a.z, a.z - low[2] - 7.0f), 0.0f);
                    if ((dx * dx + dy * dy + dz * dz) * a.w < END) held.atom[atomicAdd(&count, 1)] = a;
                }
                __syncthreads();
                int n = count;
                __syncthreads();
                if (n > HELD - LANES) {
                    add(held, n, x, y, low[2], lane, sum);
                    if (lane == 0) count = 0;
                    __syncthreads();
                }
            }
        }
    }
    int n = count;
    add(held, n, x, y, low[2], lane, sum);
    size_t row = (((size_t)(8 * X + (lane >> 3))) * (8 * by) + 8 * Y + (lane & 7)) * (8 * bz) + 8 * Z;
    float4* to = (float4*)(out + row);
    to[0] = make_float4(sum[0], sum[1], sum[2], sum[3]);
    to[1] = make_float4(sum[4], sum[5], sum[6], sum[7]);
}

struct Grid {
    int x, y, z;
};

// Returns the case of the cell at grid point i. Sets in `mask` the crossed ones of its three edges.
__device__ unsigned classify(const float* f, unsigned i, Grid n, unsigned& mask) {
    unsigned z = i % n.z, y = i / n.z % n.y, x = i / n.z / n.y;
    mask = 0;
    if (x + 1 >= n.x || y + 1 >= n.y || z + 1 >= n.z) return 0;
    unsigned dx = n.y * n.z, dy = n.z, bits = 0;
#pragma unroll
    for (unsigned c = 0; c < 8; ++c)
        bits |= (unsigned)(f[i + (c & 1) * dx + (c >> 1 & 1) * dy + (c >> 2 & 1)] >= 1.0f) << c;
    unsigned own = bits & 1;
    mask = (own ^ (bits >> 1 & 1)) | (own ^ (bits >> 2 & 1)) << 1 | (own ^ (bits >> 4 & 1)) << 2;
    return bits;
}

// Exclusive prefix sum of `value` over a block of 256 threads; `total` is the sum of the block.
__device__ unsigned before(unsigned value, unsigned& total) {
    __shared__ unsigned warps[8];
    unsigned lane = threadIdx.x & 31, warp = threadIdx.x >> 5, sum = value;
    for (unsigned d = 1; d < 32; d *= 2) {
        unsigned other = __shfl_up_sync(0xffffffffu, sum, d);
        if (lane >= d) sum += other;
    }
    if (lane == 31) warps[warp] = sum;
    __syncthreads();
    unsigned base = 0;
    total = 0;
    for (unsigned w = 0; w < 8; ++w) {
        if (w < warp) base += warps[w];
        total += warps[w];
    }
    __syncthreads();
    return base + sum - value;
}

// Counts the vertices and triangles of 256 grid points.
extern "C" __global__ void count(const float* f, int nx, int ny, int nz, const unsigned char* triangles_of, int* vertices,
                                 int* triangles) {
    unsigned mask, total;
    unsigned bits = classify(f, blockIdx.x * 256u + threadIdx.x, Grid{nx, ny, nz}, mask);
    // At most 768 and 1280, so both fit.
    before(__popc(mask) | (unsigned)triangles_of[bits] << 16, total);
    if (threadIdx.x == 0) {
        vertices[blockIdx.x] = total & 0xffff;
        triangles[blockIdx.x] = total >> 16;
    }
}

__device__ void gradient(const float* f, unsigned i, unsigned dx, unsigned dy, float* g) {
    g[0] = f[i + dx] - f[i - dx];
    g[1] = f[i + dy] - f[i - dy];
    g[2] = f[i + 1] - f[i - 1];
}

// Writes positions (A) and normals by central differences, six floats per vertex. For each grid point with vertices, `ids`
// receives its first vertex times eight plus the mask. `blocks` lists the non-empty blocks, `base` has the offsets of all.
extern "C" __global__ void vertices(const float* f, int nx, int ny, int nz, const int* blocks, const int* base, float ox,
                                    float oy, float oz, float h, unsigned* ids, float* out) {
    unsigned mask, total, i = blocks[blockIdx.x] * 256u + threadIdx.x;
    classify(f, i, Grid{nx, ny, nz}, mask);
    unsigned id = base[blocks[blockIdx.x]] + before(__popc(mask), total);
    if (!mask) return;
    ids[i] = id << 3 | mask;
    unsigned steps[3] = {(unsigned)(ny * nz), (unsigned)nz, 1u};
    float at[3] = {(float)(i / steps[0]), (float)(i / nz % ny), (float)(i % nz)};
    float origin[3] = {ox, oy, oz}, here[3], there[3];
    gradient(f, i, steps[0], steps[1], here);
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
        if (!(mask >> axis & 1)) continue;
        unsigned other = i + steps[axis];
        float t = (1.0f - f[i]) / (f[other] - f[i]);
        gradient(f, other, steps[0], steps[1], there);
        float g[3], size = 0.0f;
        for (int k = 0; k < 3; ++k) {
            g[k] = here[k] + t * (there[k] - here[k]);
            size += g[k] * g[k];
        }
        float by = -rsqrtf(size);
        float* vertex = out + 6 * (size_t)id++;
        for (int k = 0; k < 3; ++k) {
            vertex[k] = origin[k] + h * (at[k] + (k == axis ? t : 0.0f));
            vertex[3 + k] = g[k] * by;
        }
    }
}

// Writes triangles as indices of vertices. `table` has 16 cell edges per case. Edge e is along axis e / 4, from the corner whose
// two other coordinates are the bits of e % 4, lower axis first.
extern "C" __global__ void triangles(const float* f, int nx, int ny, int nz, const int* blocks, const int* base,
                                     const unsigned char* triangles_of, const unsigned char* table, const unsigned* ids,
                                     unsigned* out) {
    unsigned mask, total, i = blocks[blockIdx.x] * 256u + threadIdx.x;
    unsigned bits = classify(f, i, Grid{nx, ny, nz}, mask);
    unsigned n = triangles_of[bits];
    unsigned first = base[blocks[blockIdx.x]] + before(n, total);
    unsigned dx = ny * nz, dy = nz;
    for (unsigned k = 0; k < 3 * n; ++k) {
        unsigned e = table[16 * bits + k], axis = e >> 2, lo = e & 1, hi = e >> 1 & 1;
        unsigned owner = i + (axis == 0 ? lo * dy + hi : axis == 1 ? lo * dx + hi : lo * dx + hi * dy);
        unsigned packed = ids[owner];
        out[3 * (size_t)first + k] = (packed >> 3) + __popc(packed & 7 & ((1u << axis) - 1));
    }
}
