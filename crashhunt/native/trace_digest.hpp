// The trace digest: BLAKE2b (RFC 7693) of 16 bytes. A part of core.cpp.
//
// One chain cannot be computed in parallel: each of its 24 half rounds per 128 bytes waits for the one before. Here such
// a half round waits for fewer instructions than in hashlib: the parts of a rotation are combined with the other operand
// of its XOR in one instruction of AVX-512. 22 KB take 0.75 of hashlib's time.

#if defined(__x86_64__)
#include <immintrin.h>

#define AVX512 __attribute__((target("avx512f,avx512vl")))
#define AVX512_INLINE inline __attribute__((always_inline, target("avx512f,avx512vl")))

const uint64_t BLAKE2B_START[8] = {0x6a09e667f3bcc908, 0xbb67ae8584caa73b, 0x3c6ef372fe94f82b, 0xa54ff53a5f1d36f1,
                                   0x510e527fade682d1, 0x9b05688c2b3e6c1f, 0x1f83d9abfb41bd6b, 0x5be0cd19137e2179};
const size_t BLOCK = 128, DIGEST_SIZE = 16;

// The words of a block in each round: those that columns add first, then second, and so those of diagonals.
alignas(64) const uint64_t WORDS[10][4][4] = {
    {{0, 2, 4, 6}, {1, 3, 5, 7}, {14, 8, 10, 12}, {15, 9, 11, 13}},
    {{14, 4, 9, 13}, {10, 8, 15, 6}, {5, 1, 0, 11}, {3, 12, 2, 7}},
    {{11, 12, 5, 15}, {8, 0, 2, 13}, {9, 10, 3, 7}, {4, 14, 6, 1}},
    {{7, 3, 13, 11}, {9, 1, 12, 14}, {15, 2, 5, 4}, {8, 6, 10, 0}},
    {{9, 5, 2, 10}, {0, 7, 4, 15}, {3, 14, 11, 6}, {13, 1, 12, 8}},
    {{2, 6, 0, 8}, {12, 10, 11, 3}, {1, 4, 7, 15}, {9, 13, 5, 14}},
    {{12, 1, 14, 4}, {5, 15, 13, 10}, {8, 0, 6, 9}, {11, 7, 3, 2}},
    {{13, 7, 12, 3}, {11, 14, 1, 9}, {2, 5, 15, 8}, {10, 0, 4, 6}},
    {{6, 14, 11, 0}, {15, 9, 3, 8}, {10, 12, 13, 1}, {5, 2, 7, 4}},
    {{10, 8, 7, 1}, {2, 4, 6, 5}, {13, 15, 9, 3}, {0, 11, 14, 12}},
};

// x ^ y, turned by some bits to the right; x is known long before y.
template <int bits> AVX512_INLINE __m256i turned(__m256i x, __m256i y) {
    return _mm256_ternarylogic_epi64(_mm256_srli_epi64(y, bits), _mm256_slli_epi64(y, 64 - bits),
                                     _mm256_ror_epi64(x, bits), 0x96);
}

AVX512_INLINE void mix(__m256i &a, __m256i &b, __m256i &c, __m256i &d, __m512i words) {
    a = _mm256_add_epi64(a, _mm512_castsi512_si256(words));
    asm("" : "+v"(a)); // or the compiler adds b, for which the rest waits, first
    a = _mm256_add_epi64(a, b);
    __m256i next = _mm256_add_epi64(a, _mm512_extracti64x4_epi64(words, 1));
    asm("" : "+v"(next));
    d = _mm256_shuffle_epi32(_mm256_xor_si256(d, a), 0xb1);
    c = _mm256_add_epi64(c, d);
    b = turned<24>(b, c);
    a = _mm256_add_epi64(next, b);
    d = turned<16>(d, a);
    c = _mm256_add_epi64(c, d);
    b = turned<63>(b, c);
}

// Hashes blocks of so many bytes of the message; they are whole, or the last one, which zeros fill up.
AVX512 void hash_blocks(uint64_t *state, const char *data, size_t blocks, uint64_t &hashed, size_t size, bool last) {
    __m256i *const halves = reinterpret_cast<__m256i *>(state);
    __m256i low = _mm256_loadu_si256(halves), high = _mm256_loadu_si256(halves + 1);
    const __m256i *const start = reinterpret_cast<const __m256i *>(BLAKE2B_START);
    const __m256i start_low = _mm256_loadu_si256(start), start_high = _mm256_loadu_si256(start + 1);
    for (; blocks; blocks--, data += BLOCK) {
        hashed += size;
        const __m512i one = _mm512_loadu_si512(data), two = _mm512_loadu_si512(data + 64);
        __m256i a = low, b = high, c = start_low;
        __m256i d = _mm256_xor_si256(start_high, _mm256_setr_epi64x(static_cast<long long>(hashed), 0, last ? -1 : 0, 0));
        for (int round = 0; round < 12; round++) {
            const uint64_t(*words)[4] = WORDS[round % 10];
            mix(a, b, c, d, _mm512_permutex2var_epi64(one, _mm512_load_si512(words), two));
            a = _mm256_permute4x64_epi64(a, 0x93);
            d = _mm256_permute4x64_epi64(d, 0x4e);
            c = _mm256_permute4x64_epi64(c, 0x39);
            mix(a, b, c, d, _mm512_permutex2var_epi64(one, _mm512_load_si512(words + 2), two));
            a = _mm256_permute4x64_epi64(a, 0x39);
            d = _mm256_permute4x64_epi64(d, 0x4e);
            c = _mm256_permute4x64_epi64(c, 0x93);
        }
        low = _mm256_ternarylogic_epi64(low, a, c, 0x96);
        high = _mm256_ternarylogic_epi64(high, b, d, 0x96);
    }
    _mm256_storeu_si256(halves, low);
    _mm256_storeu_si256(halves + 1, high);
}

struct TraceDigest {
    uint64_t state[8], hashed = 0;
    char rest[BLOCK] = {};
    size_t kept = 0; // bytes in the rest

    TraceDigest() {
        memcpy(state, BLAKE2B_START, sizeof state);
        state[0] ^= 0x01010000 | DIGEST_SIZE;
    }
    void add(const char *data, size_t size) {
        while (size) { // the last block, even a whole one, is kept for `finish`
            if (kept == BLOCK) {
                hash_blocks(state, rest, 1, hashed, BLOCK, false);
                kept = 0;
            }
            const size_t whole = kept ? 0 : (size - 1) / BLOCK;
            hash_blocks(state, data, whole, hashed, BLOCK, false);
            data += whole * BLOCK;
            size -= whole * BLOCK;
            const size_t taken = std::min(size, BLOCK - kept);
            memcpy(rest + kept, data, taken);
            kept += taken;
            data += taken;
            size -= taken;
        }
    }
    PyObject *finish() {
        memset(rest + kept, 0, BLOCK - kept);
        hash_blocks(state, rest, 1, hashed, kept, true);
        return PyBytes_FromStringAndSize(reinterpret_cast<const char *>(state), DIGEST_SIZE);
    }
};

// digest(list of buffers) -> bytes | None where the processor has no AVX-512
PyObject *digest(PyObject *, PyObject *list) {
    if (!PyList_CheckExact(list)) {
        return PyErr_Format(PyExc_TypeError, "a digest is of a list of buffers");
    }
    if (!__builtin_cpu_supports("avx512f") || !__builtin_cpu_supports("avx512vl")) {
        Py_RETURN_NONE;
    }
    TraceDigest whole;
    for (Py_ssize_t number = 0; number < PyList_GET_SIZE(list); number++) {
        Py_buffer buffer;
        if (PyObject_GetBuffer(PyList_GET_ITEM(list, number), &buffer, PyBUF_C_CONTIGUOUS) < 0) {
            return nullptr;
        }
        whole.add(static_cast<const char *>(buffer.buf), static_cast<size_t>(buffer.len));
        PyBuffer_Release(&buffer);
    }
    return whole.finish();
}
#else
PyObject *digest(PyObject *, PyObject *) { Py_RETURN_NONE; }
#endif
