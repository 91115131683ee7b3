/* The part of an amplifier that CANopenNode leaves to its maker: converters behind 0x6411 and 0x6401, and what the
 * outputs do outside operational. Built into canopend with -DCO_USE_APPLICATION. The plant is whoever answers at the
 * UDP port in PLANT_PORT: three 16-bit counts there, three back.
 */
#include <arpa/inet.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include "CO_application.h"
#include "OD.h"

static int plant = -1;
static uint8_t driven[6], sensed[6];
static OD_extension_t sense_io, drive_io;
static CO_t *node;

static void exchange(void) {
    if (plant >= 0 && send(plant, driven, sizeof driven, 0) == sizeof driven) {
        uint8_t answer[sizeof sensed];
        if (recv(plant, answer, sizeof answer, 0) == sizeof answer) memcpy(sensed, answer, sizeof sensed);
    }
}

static bool_t is_operational(void) { return node != NULL && CO_NMT_getInternalState(node->NMT) == CO_NMT_OPERATIONAL; }

/* 0x6401:1 is read once for each sense PDO, and then the other two are of the same instant. */
static ODR_t read_sense(OD_stream_t *stream, void *buf, OD_size_t count, OD_size_t *countRead) {
    if (stream->subIndex == 1) exchange();
    if (stream->subIndex >= 1 && stream->subIndex <= 3) memcpy(stream->dataOrig, sensed + 2 * (stream->subIndex - 1), 2);
    return OD_readOriginal(stream, buf, count, countRead);
}

static ODR_t write_drive(OD_stream_t *stream, const void *buf, OD_size_t count, OD_size_t *countWritten) {
    ODR_t result = OD_writeOriginal(stream, buf, count, countWritten);
    if (result == ODR_OK && is_operational() && stream->subIndex >= 1 && stream->subIndex <= 3) {
        memcpy(driven + 2 * (stream->subIndex - 1), stream->dataOrig, 2);
        if (stream->subIndex == 3) exchange();
    }
    return result;
}

CO_ReturnError_t app_programStart(uint16_t *bitRate, uint8_t *nodeId, uint32_t *errInfo) {
    (void)bitRate, (void)nodeId, (void)errInfo;
    const char *port = getenv("PLANT_PORT");
    if (port != NULL) {
        struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(port))};
        struct timeval patience = {.tv_sec = 1};
        to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        plant = socket(AF_INET, SOCK_DGRAM, 0);
        setsockopt(plant, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
        connect(plant, (struct sockaddr *)&to, sizeof to);
    }
    sense_io = (OD_extension_t){.read = read_sense, .write = NULL};
    drive_io = (OD_extension_t){.read = OD_readOriginal, .write = write_drive};
    OD_extension_init(OD_find(OD, 0x6401), &sense_io);
    OD_extension_init(OD_find(OD, 0x6411), &drive_io);
    return CO_ERROR_NO;
}

void app_communicationReset(CO_t *co) { node = co; }
void app_programEnd(void) { close(plant); }
void app_programRt(CO_t *co, uint32_t timer1usDiff) { (void)co, (void)timer1usDiff; }

void app_programAsync(CO_t *co, uint32_t timer1usDiff) {
    static const uint8_t zero[6];
    (void)co, (void)timer1usDiff;
    if (is_operational() || memcmp(driven, zero, sizeof driven) == 0) return;
    for (uint8_t comb = 1; comb <= 3; comb++) { /* CiA 401: mode 1 takes the error value, mode 0 keeps what is there */
        uint8_t mode = 0;
        int32_t value = 0;
        OD_get_u8(OD_find(OD, 0x6443), comb, &mode, true);
        OD_get_i32(OD_find(OD, 0x6444), comb, &value, true);
        if (mode == 0) continue;
        driven[2 * comb - 2] = (uint8_t)value;
        driven[2 * comb - 1] = (uint8_t)(value >> 8);
        OD_set_i16(OD_find(OD, 0x6411), comb, (int16_t)value, true);
    }
    exchange();
}
